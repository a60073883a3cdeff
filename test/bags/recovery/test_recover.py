"""Torn bags made whole again, read by other libraries."""

from __future__ import annotations

import os
import resource
import shutil
import struct
import subprocess
import sys
from pathlib import Path as FilePath

import pytest
import yaml
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

import torn_bags
from adp_path_follower.bags.reader import read_run
from adp_path_follower.bags.recovery.mcap_scan import MOST_BYTES
from adp_path_follower.bags.recovery.recover import recover
from adp_path_follower.core.errors import FileError
from adp_path_follower.study.replay.replay import replay
from folders import ROOT

FLOAT = "std_msgs/msg/Float64"
VARIANTS = ("plain", "chunks", "lz4", "zstd")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> FilePath:
    """Return the bag of a run; do not change it."""
    bag = tmp_path_factory.mktemp("run") / "run"
    torn_bags.write_run(bag)
    return bag


@pytest.fixture(scope="module")
def files(run) -> dict[str, bytes]:
    """Return its file as several recorders would write it."""
    return torn_bags.variants(run)


def _information(bag: FilePath) -> dict:
    return yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]


def _frame(content: bytes, wanted: int, number: int) -> tuple[int, int]:
    """Return beginning and end of a record of some kind."""
    found = [(a, b) for opcode, a, b in torn_bags.boundaries(content) if opcode == wanted]
    return found[number]


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_whole_bag_comes_out_equal(run, files, tmp_path, variant):
    bag = torn_bags.copy_with(run, tmp_path / "run", files[variant])
    fractions: list[float] = []
    recovery = recover(bag, progress=fractions.append)
    assert recovery.bag == tmp_path / "run_recovered"
    assert recovery.bytes_left == 0
    assert fractions == sorted(fractions)
    assert all(0.0 <= fraction <= 1.0 for fraction in fractions)
    assert torn_bags.contents(recovery.bag) == torn_bags.contents(run)
    new_file = recovery.bag / "run_recovered_0.mcap"
    assert torn_bags.schemas(new_file) == torn_bags.schemas(run / "run_0.mcap")
    new, old = _information(recovery.bag), _information(run)
    assert new.pop("relative_file_paths") == [new_file.name]
    assert new.pop("files")[0].pop("message_count") == old.pop("files")[0].pop("message_count")
    del old["relative_file_paths"]
    assert new == old


def test_other_libraries_read_a_recovered_bag_strictly(run, files, tmp_path):
    content = files["plain"][: len(files["plain"]) // 2]
    recovery = recover(torn_bags.copy_with(run, tmp_path / "bag", content))
    expected = torn_bags.contents(run)[: _whole(content, files)]
    assert torn_bags.contents(recovery.bag) == expected  # with checksums
    with (recovery.bag / "bag_recovered_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        statistics = summary.statistics
        assert statistics.message_count == len(expected) == sum(recovery.message_counts.values())
        assert statistics.message_start_time == min(time for _, time, _, _ in expected)
        assert statistics.message_end_time == max(time for _, time, _, _ in expected)
        by_topic = {
            summary.channels[number].topic: count
            for number, count in statistics.channel_message_counts.items()
        }
        assert by_topic == recovery.message_counts
        assert summary.chunk_indexes
        indexed = [
            (c.topic, m.log_time, m.publish_time, m.data) for _, c, m in reader.iter_messages()
        ]
        assert sorted(indexed) == sorted(expected)
    with AnyReader([recovery.bag]) as reader:
        raw = [(c.topic, time, bytes(data)) for c, time, data in reader.messages()]
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
        assert {c.topic: c.msgcount for c in reader.connections} == recovery.message_counts
        assert all(len(c.ext.offered_qos_profiles) == 1 for c in reader.connections)
    assert sorted(raw) == sorted((topic, time, data) for topic, time, _, data in expected)
    assert replay(read_run(recovery.bag)).identical.all()


def _whole(content: bytes, files: dict[str, bytes]) -> int:
    return sum(end <= len(content) for end in torn_bags.message_ends(files["plain"]))


def test_the_decoder_of_mcap_reads_a_recovered_bag(run, files, tmp_path):
    bag = torn_bags.copy_with(run, tmp_path / "bag", files["plain"][:-500])
    recovery = recover(bag)
    with (recovery.bag / "bag_recovered_0.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        decoded = [found for _, _, _, found in reader.iter_decoded_messages()]
    assert len(decoded) == sum(recovery.message_counts.values()) > 0
    assert decoded[2].pose.pose.position.x == -0.1


def _damage(content: bytes, way: str) -> tuple[bytes, set[int]]:
    """Return a file damaged in the middle, and which of its messages are lost."""
    data = bytearray(content)
    begin, end = _frame(content, Opcode.MESSAGE, 20)
    lost = {20}
    if way == "opcode":
        data[begin] = 0
    elif way == "unknown channel":
        struct.pack_into("<H", data, begin + 9, 999)
    elif way == "impossible time":
        struct.pack_into("<Q", data, begin + 15, 2**63)
    elif way == "huge length":
        struct.pack_into("<Q", data, begin + 1, 2**62)
    elif way == "length beyond the end":
        struct.pack_into("<Q", data, begin + 1, len(content))
    elif way == "too long":
        struct.pack_into("<Q", data, begin + 1, end - begin - 9 + 60)
    elif way == "too short":
        struct.pack_into("<Q", data, begin + 1, end - begin - 9 - 8)
    elif way == "noise between":
        data[begin:begin] = bytes(range(256)) * 9
        lost = set()
    elif way == "zeros":
        last = _frame(content, Opcode.MESSAGE, 25)[1]
        data[begin + 5 : last - 5] = bytes(last - begin - 10)
        lost = set(range(20, 26))
    elif way == "trailing garbage":
        data += bytes(range(256)) * 30
        lost = set()
    elif way == "garbage instead of the end":
        stop = torn_bags.message_ends(content)[30]
        data[stop:] = b"\xff" * 5000
        lost = set(range(31, 1000))
    return bytes(data), lost


@pytest.mark.parametrize(
    "way",
    [
        *("opcode", "unknown channel", "impossible time", "huge length", "length beyond the end"),
        *("too long", "too short", "noise between", "zeros", "trailing garbage"),
        "garbage instead of the end",
    ],
)
def test_only_what_is_damaged_is_left(run, files, tmp_path, way):
    content, lost = _damage(files["plain"], way)
    recovery = recover(torn_bags.copy_with(run, tmp_path / "bag", content))
    kept = [m for number, m in enumerate(torn_bags.contents(run)) if number not in lost]
    assert torn_bags.contents(recovery.bag) == kept
    assert 0 < recovery.bytes_left < 8000


@pytest.mark.parametrize("variant", ["chunks", "lz4", "zstd"])
def test_a_chunk_with_a_wrong_checksum_is_left_whole(run, files, tmp_path, variant):
    data = bytearray(files[variant])
    begin, end = _frame(files[variant], Opcode.CHUNK, 3)
    data[(begin + end) // 2] ^= 1
    recovery = recover(torn_bags.copy_with(run, tmp_path / "bag", bytes(data)))
    saved, all_messages = torn_bags.contents(recovery.bag), torn_bags.contents(run)
    assert 0 < len(all_messages) - len(saved) < 15
    assert [m for m in all_messages if m in set(saved)] == saved
    assert recovery.bytes_left == end - begin - 9


@pytest.mark.parametrize("variant", VARIANTS)
def test_one_bit_makes_no_message_of_another_record(run, files, tmp_path, variant):
    """An index of a chunk is as long as a message, and begins with a channel too."""
    content, all_messages = files[variant], set(torn_bags.contents(run))
    by_opcode: dict[int, list[int]] = {}
    for opcode, begin, _ in torn_bags.boundaries(content):
        by_opcode.setdefault(opcode, []).append(begin)
    del by_opcode[Opcode.MESSAGE if variant == "plain" else Opcode.CHUNK]
    for begin in (begin for begins in by_opcode.values() for begin in begins[:2]):
        for bit in range(8):
            data = bytearray(content)
            data[begin] ^= 1 << bit
            bag = torn_bags.copy_with(run, tmp_path / "bag", bytes(data))
            recovery = recover(bag, tmp_path / "new")
            assert set(torn_bags.contents(recovery.bag)) == all_messages
            shutil.rmtree(recovery.bag)


def test_definitions_come_from_the_end_if_damaged_at_the_beginning(run, files, tmp_path):
    data = bytearray(files["plain"])
    for opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        begin, end = _frame(files["plain"], opcode, 1)
        data[begin + 9 : end] = b"\xff" * (end - begin - 9)
    recovery = recover(torn_bags.copy_with(run, tmp_path / "bag", bytes(data)))
    assert torn_bags.contents(recovery.bag) == torn_bags.contents(run)


def test_a_definition_that_cannot_be_read_is_replaced_by_that_of_jazzy(run, files, tmp_path):
    begin, end = _frame(files["plain"], Opcode.SCHEMA, 2)
    torn = bytearray(files["plain"][: torn_bags.message_ends(files["plain"])[-1]])
    torn[end - 40 : end] = b"\xfe" * 40
    assert begin < end - 40
    recovery = recover(torn_bags.copy_with(run, tmp_path / "bag", bytes(torn)))
    assert torn_bags.contents(recovery.bag) == torn_bags.contents(run)
    assert replay(read_run(recovery.bag)).identical.all()


SERVICE_EVENTS = {
    "the service": b"bool data\n---\nbool success\nstring message\n",
    "the event": b"service_msgs/ServiceEventInfo info\nstd_srvs/SetBool_Request[<=1] request\n",
    "nothing": b"",
}


@pytest.mark.parametrize("chunked", [False, True])
@pytest.mark.parametrize("definition", SERVICE_EVENTS)
def test_service_events_of_a_sound_bag_are_kept(tmp_path, definition, chunked):
    """The library does not know the language of their definition; their bytes are sound."""
    bag = tmp_path / "bag"
    bag.mkdir()
    with (bag / "bag_0.mcap").open("wb") as stream:
        writer = Writer(stream, use_chunking=chunked)
        writer.start(profile="ros2", library="x")
        float_id = writer.register_schema(FLOAT, "ros2msg", b"float64 data\n")
        event = ("std_srvs/srv/SetBool_Event", "ros2msg", SERVICE_EVENTS[definition])
        event_id = writer.register_schema(*event)
        value = writer.register_channel("/x", "cdr", float_id, {})
        service = writer.register_channel("/x/_service_event", "cdr", event_id, {})
        expected = []
        for number in range(10):
            at_service = number not in (3, 7)
            data = b"\0\1\0\0" + bytes([number] * 37)
            data = data if at_service else torn_bags.message(FLOAT, float(number))
            writer.add_message(service if at_service else value, number, data, number)
            topic = "/x/_service_event" if at_service else "/x"
            expected.append((topic, number, number, data))
        writer.finish()
    recovery = recover(bag, tmp_path / "new")
    assert recovery.bytes_left == 0
    assert torn_bags.contents(recovery.bag) == expected
    new_file = recovery.bag / "new_0.mcap"
    assert torn_bags.schemas(new_file) == torn_bags.schemas(bag / "bag_0.mcap")


@pytest.mark.parametrize("chunked", [False, True])
def test_messages_without_a_schema_are_kept(tmp_path, chunked):
    bag = tmp_path / "bag.mcap"
    with bag.open("wb") as stream:
        writer = Writer(stream, use_chunking=chunked)
        writer.start(profile="ros2", library="x")
        channel = writer.register_channel("/json", "json", 0)
        for number in range(10):
            writer.add_message(channel, number, b'{"a": %d}' % number, number)
        writer.finish()
    recovery = recover(bag, tmp_path / "new")
    assert recovery.bytes_left == 0
    expected = [("/json", number, number, b'{"a": %d}' % number) for number in range(10)]
    with (recovery.bag / "new_0.mcap").open("rb") as stream:
        messages = list(make_reader(stream).iter_messages())
    assert [(c.topic, m.log_time, m.publish_time, m.data) for _, c, m in messages] == expected
    assert all(schema is None for schema, _, _ in messages)


def test_several_files_become_one_in_the_order_of_their_numbers(tmp_path):
    bag = tmp_path / "bag"
    bag.mkdir()
    expected = []
    for number in range(12):
        with (bag / f"bag_{number}.mcap").open("wb") as stream:
            writer = _writer(stream)
            data = torn_bags.message(FLOAT, float(number))
            writer.add_message(1, 1000 - number, data, number)  # times that go back stay
            expected.append(("/x", 1000 - number, number, data))
            if number != 7:  # the torn one
                writer.finish()
    recovery = recover(bag, tmp_path / "new")
    assert torn_bags.contents(recovery.bag) == expected
    assert recovery.message_counts == {"/x": 12}
    with AnyReader([recovery.bag]) as reader:
        assert [time for _, time, _ in reader.messages()] == list(range(989, 1001))
    start = _information(recovery.bag)["starting_time"]["nanoseconds_since_epoch"]
    assert start == 989


def _writer(stream, metadata: dict[str, str] | None = None, **chunks) -> Writer:
    """Return a writer with one topic."""
    writer = Writer(stream, **(chunks or {"use_chunking": False}))
    writer.start(profile="ros2")
    writer.register_schema(FLOAT, "ros2msg", b"float64 data\n")
    writer.register_channel("/x", "cdr", 1, metadata or {})
    return writer


def test_qos_profiles_come_from_the_channel_or_from_metadata(run, files, tmp_path):
    numbered = {**torn_bags.QOS, "history": 1, "reliability": 2, "durability": 1, "liveliness": 1}
    bag = tmp_path / "old.mcap"
    with bag.open("wb") as stream:
        stated = {"offered_qos_profiles": yaml.safe_dump([numbered])}
        _writer(stream, stated).add_message(1, 1, torn_bags.message(FLOAT, 1.0), 1)
    recovery = recover(bag)
    found = _information(recovery.bag)["topics_with_message_count"][0]["topic_metadata"]
    names = {"reliability": "best_effort", "durability": "transient_local"}
    assert found["offered_qos_profiles"] == [{**torn_bags.QOS, **names}]
    with AnyReader([recovery.bag]) as reader:
        assert reader.message_count == len(list(reader.messages())) == 1
    # A channel that says nothing of QoS: metadata.yaml does.
    plain = files["plain"].replace(b"offered_qos_profiles", b"offered_qos_profilez")
    recovery = recover(torn_bags.copy_with(run, tmp_path / "bag", plain))
    for topic in _information(recovery.bag)["topics_with_message_count"]:
        assert topic["topic_metadata"]["offered_qos_profiles"] == [torn_bags.QOS]
    with AnyReader([recovery.bag]) as reader:
        assert len(list(reader.messages())) == len(torn_bags.contents(run))


def test_a_recording_without_metadata_and_without_messages(run, files, tmp_path):
    first = _frame(files["plain"], Opcode.MESSAGE, 0)[0]
    bag = torn_bags.copy_with(run, tmp_path / "bag", files["plain"][:first])
    (bag / "metadata.yaml").write_bytes(b"\x00garbage: [")
    recovery = recover(bag)
    assert set(recovery.message_counts.values()) == {0}
    assert recovery.bytes_left == 0
    with AnyReader([recovery.bag]) as reader:
        assert list(reader.messages()) == []


def test_a_chunk_that_says_it_unpacks_to_very_much_is_left(tmp_path):
    bag = tmp_path / "bomb.mcap"
    with bag.open("wb") as stream:
        writer = _writer(stream, compression=CompressionType.ZSTD)
        writer.add_message(1, 1, bytes(MOST_BYTES), 1)
        writer.finish()
    assert bag.stat().st_size < 100_000
    assert recover(bag).message_counts == {"/x": 0}


def _adp(*arguments: str, cwd: FilePath, most_bytes: int = -1) -> subprocess.CompletedProcess[str]:
    """Run the command, which may write files of so many bytes."""
    limit = (most_bytes, most_bytes)
    return subprocess.run(
        [sys.executable, "-m", "adp_path_follower.cli.main", "recover", *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        timeout=60,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit),
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


@pytest.mark.smoke
def test_the_command_tells_what_was_saved_and_left(run, files, tmp_path):
    torn = files["plain"][:-2000]
    bag = torn_bags.copy_with(run, tmp_path / "bag", torn)
    done = _adp("bag/", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    counts = {line.split()[1]: int(line.split()[0]) for line in done.stdout.splitlines()[1:-1]}
    assert len(counts) == 5
    assert f"saved {sum(counts.values())} messages to" in done.stdout
    assert f"of {len(torn)} bytes that could not be read" in done.stdout
    assert (tmp_path / "bag_recovered" / "metadata.yaml").is_file()
    assert (bag / "run_0.mcap").read_bytes() == torn
    again = _adp("bag", cwd=tmp_path)
    assert again.returncode == 2
    assert "bag_recovered exists already: choose another name" in again.stderr
    assert len(again.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("most_bytes", [100, 20_000])
def test_a_disk_that_is_full_is_one_sentence_and_leaves_nothing(run, tmp_path, most_bytes):
    done = _adp(str(run), "--out", "new", cwd=tmp_path, most_bytes=most_bytes)
    assert done.returncode == 2
    assert "File too large" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    if most_bytes > 10_000:  # else not even its metadata.yaml could be written
        assert list(tmp_path.iterdir()) == []


REFUSALS = {
    "missing": "bag .*missing does not exist",
    "folder": "folder holds no .mcap file: give a bag's directory or its file",
    "sqlite": r"sqlite is an sqlite3 bag \(.db3\), not MCAP",
    "bag.db3": r"bag.db3 is an sqlite3 bag \(.db3\), not MCAP",
    "packed": "packed has compressed files: unpack them first with `zstd -d`",
    "text.txt": "text.txt is no MCAP file",
    "text.mcap": "text.mcap holds nothing that could be recovered",
    "empty.mcap": "empty.mcap is empty: nothing was written",
    "emptied": "emptied is empty: nothing was written",
    "pipe": "pipe is neither a directory nor a file",
}


@pytest.mark.parametrize("name", REFUSALS)
def test_what_is_no_torn_bag_is_refused_in_one_sentence(tmp_path, name):
    for folder, file in (("folder", "x.txt"), ("sqlite", "x_0.db3"), ("packed", "x.mcap.zstd")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / file).write_bytes(b"x")
    (tmp_path / "emptied").mkdir()
    (tmp_path / "emptied" / "emptied_0.mcap").touch()
    (tmp_path / "bag.db3").write_bytes(b"SQLite format 3\0")
    (tmp_path / "text.txt").write_text("text")
    (tmp_path / "text.mcap").write_text("text" * 1000)
    (tmp_path / "empty.mcap").touch()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(FileError, match=REFUSALS[name]):
        recover(tmp_path / name, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_the_new_bag_overwrites_nothing(run, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("mine")
    with pytest.raises(FileError, match="exists already"):
        recover(run, tmp_path / "mine")
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["file"]
