"""Bags in several files, files written by a thread, and what happens on a full disk."""

from __future__ import annotations

import errno
import itertools
import random
import resource
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path as FilePath

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.bags.bag_file import BackgroundFile
from adp_path_follower.bags.recovery.recover import recover
from adp_path_follower.bags.writer import BagWriter, Limits
from adp_path_follower.core.errors import FileError

STORE = get_typestore(Stores.ROS2_JAZZY)
TEXT = STORE.types["std_msgs/msg/String"]
SECOND = 1_000_000_000


def text_message(number: int, length: int = 1000) -> bytes:
    text = f"{number:08d}" * (length // 8)
    return bytes(STORE.serialize_cdr(TEXT(text), TEXT.__msgtype__))


def write(directory: FilePath, count: int, **options: object) -> list[bytes]:
    """Write messages, ten in a second, to two topics in turn; a third one stays empty."""
    writer = BagWriter(directory, **options)
    topics = [writer.add_topic(f"/{name}", "std_msgs/msg/String") for name in "abc"]
    written = [text_message(number) for number in range(count)]
    for number, message in enumerate(written):
        time = SECOND + number * SECOND // 10
        writer.write(topics[number % 2], message, time, time)
        if number % 3 == 0:
            writer.flush()
    writer.close()
    return written


def information(bag: FilePath) -> dict:
    content = yaml.safe_load((bag / "metadata.yaml").read_text())
    return content["rosbag2_bagfile_information"]


def read(bag: FilePath) -> list[bytes]:
    with AnyReader([bag]) as reader:
        return [bytes(raw) for _, _, raw in reader.messages()]


@pytest.fixture(params=["none", "zstd"])
def options(request) -> dict:
    return {"compression": request.param, "background": True}


def test_split_by_duration(tmp_path, options):
    bag = tmp_path / "bag"
    written = write(bag, 95, limits=Limits(duration=2 * SECOND), **options)
    assert read(bag) == written
    found = information(bag)
    names = [f"bag_{index}.mcap" for index in range(5)]
    assert sorted(file.name for file in bag.iterdir()) == [*names, "metadata.yaml"]
    assert found["relative_file_paths"] == names
    assert found["files"] == [
        {
            "path": name,
            "duration": {"nanoseconds": (count - 1) * SECOND // 10},
            "starting_time": {"nanoseconds_since_epoch": SECOND + 2 * index * SECOND},
            "message_count": count,
        }
        for index, (name, count) in enumerate(zip(names, [20, 20, 20, 20, 15], strict=True))
    ]
    assert found["duration"]["nanoseconds"] == 94 * SECOND // 10
    assert found["starting_time"]["nanoseconds_since_epoch"] == SECOND
    assert found["message_count"] == 95
    counts = {
        topic["topic_metadata"]["name"]: topic["message_count"]
        for topic in found["topics_with_message_count"]
    }
    assert counts == {"/a": 48, "/b": 47, "/c": 0}


def test_every_file_of_a_split_bag_stands_alone(tmp_path, options):
    write(tmp_path / "bag", 50, limits=Limits(duration=2 * SECOND), **options)
    for file, count in zip(information(tmp_path / "bag")["files"], (20, 20, 10), strict=True):
        with (tmp_path / "bag" / file["path"]).open("rb") as stream:
            summary = make_reader(stream, validate_crcs=True).get_summary()
        assert {channel.topic for channel in summary.channels.values()} == {"/a", "/b", "/c"}
        assert len(summary.schemas) == 1
        assert summary.statistics.message_count == count == file["message_count"]


def test_split_by_size(tmp_path, options):
    bag = tmp_path / "bag"
    written = write(bag, 100, limits=Limits(size=10_000), **options)
    assert read(bag) == written
    files = information(bag)["files"]
    assert 2 <= len(files) <= 15
    for file in files:
        with (bag / file["path"]).open("rb") as stream:
            summary = make_reader(stream).get_summary()
        messages_end = (bag / file["path"]).stat().st_size - 2000  # index
        assert messages_end <= 10_000
        assert summary.statistics.message_count == file["message_count"]


def test_a_message_above_the_size_gets_a_file_of_its_own(tmp_path):
    writer = BagWriter(tmp_path / "bag", limits=Limits(size=10_000))
    topic = writer.add_topic("/a", "std_msgs/msg/String")
    for number, length in enumerate((100, 50_000, 100)):
        writer.write(topic, text_message(number, length), number, number)
    writer.close()
    assert [file["message_count"] for file in information(tmp_path / "bag")["files"]] == [1, 1, 1]
    assert len(read(tmp_path / "bag")) == 3


def test_topics_that_come_after_a_split(tmp_path):
    writer = BagWriter(tmp_path / "bag", limits=Limits(duration=SECOND), background=True)
    first = writer.add_topic("/a", "std_msgs/msg/String")
    writer.write(first, text_message(0), 0, 0)
    writer.write(first, text_message(1), SECOND, SECOND)
    second = writer.add_topic("/b", "geometry_msgs/msg/Vector3")
    writer.write(second, bytes(28), SECOND + 1, SECOND + 1)
    writer.write(second, bytes(28), 2 * SECOND, 2 * SECOND)
    writer.close()
    with AnyReader([tmp_path / "bag"]) as reader:
        found = [(connection.topic, time) for connection, time, _ in reader.messages()]
    assert found == [("/a", 0), ("/a", SECOND), ("/b", SECOND + 1), ("/b", 2 * SECOND)]


def test_what_was_flushed_can_be_recovered(tmp_path, options):
    """Without `close`, as after kill -9."""
    writer = BagWriter(tmp_path / "bag", limits=Limits(duration=2 * SECOND), **options)
    topic = writer.add_topic("/a", "std_msgs/msg/String")
    written = [text_message(number) for number in range(50)]
    for number, message in enumerate(written):
        writer.write(topic, message, number * SECOND // 10, 0)
    writer.flush()
    _until(lambda: _recovered(tmp_path / "bag") == written)
    writer.close()


def _until(condition: Callable[[], object]) -> None:
    """Wait for the thread that writes."""
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def _recovered(bag: FilePath) -> list[bytes]:
    """Return the messages that can be recovered from a torn bag by now."""
    target = bag.parent / "recovered"
    shutil.rmtree(target, ignore_errors=True)
    try:
        return read(recover(bag, target).bag)
    except FileError:
        return []


@pytest.fixture
def limit_files() -> Iterator[Callable[[int], None]]:
    """Let no file of this process grow beyond a size: writing fails then as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk_leaves_whole_records(tmp_path, options, limit_files):
    limit_files(2_000_000)
    writer = BagWriter(tmp_path / "bag", **options)
    topic = writer.add_topic("/a", "sensor_msgs/msg/Image")
    chance = random.Random(1)  # noqa: S311  # so that zstd cannot pack it
    written = [chance.randbytes(100_000) for _ in range(40)]
    numbers = itertools.count()

    def is_full() -> bool:
        number = next(numbers)
        try:
            writer.write(topic, written[min(number, 39)], number, number)
            writer.flush()
        except OSError as error:
            return error.errno == errno.EFBIG
        return False

    _until(is_full)
    with pytest.raises(OSError, match="File too large"):
        writer.close()
    saved = recover(tmp_path / "bag")
    assert saved.bytes_left == 0
    found = read(saved.bag)
    assert 10 <= len(found) <= 20
    assert found == written[: len(found)]


def test_a_background_file_goes_on_when_there_is_room_again(tmp_path, limit_files):
    limit_files(2_000_000)
    file = BackgroundFile(tmp_path / "file")
    pieces = [bytes([number]) * 300_000 for number in range(10)]
    for piece in pieces:
        file.write(piece)

    def has_failed() -> bool:
        try:
            file.flush()
        except OSError as error:
            return error.errno == errno.EFBIG
        return False

    _until(has_failed)
    assert (tmp_path / "file").stat().st_size == 6 * 300_000
    limit_files(10_000_000)
    file.close()
    assert (tmp_path / "file").read_bytes() == b"".join(pieces)


def test_a_bag_that_cannot_be_begun_leaves_nothing(tmp_path, limit_files):
    limit_files(500_000)
    with pytest.raises(FileError, match="cannot be written: File too large"):
        BagWriter(tmp_path / "bag", background=True)
    assert not (tmp_path / "bag").exists()
