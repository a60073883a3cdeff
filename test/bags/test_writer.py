"""Bags that are written here, read by other libraries."""

from __future__ import annotations

from pathlib import Path as FilePath

import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.bags.installed_types import type_text
from adp_path_follower.bags.reader import read_run
from adp_path_follower.bags.writer import BagExistsError, BagWriter, Limits, UnknownTypeError
from adp_path_follower.core.errors import FileError

STORE = get_typestore(Stores.ROS2_JAZZY)
VECTOR = STORE.types["geometry_msgs/msg/Vector3"]
FLOAT = STORE.types["std_msgs/msg/Float64"]


def _write(directory: FilePath, count: int = 50, **options: object) -> list[bytes]:
    writer = BagWriter(directory, {"host": "here"}, **options)
    vectors = writer.add_topic("/vector", "geometry_msgs/msg/Vector3")
    floats = writer.add_topic("/float", "std_msgs/msg/Float64")
    written = []
    for index in range(count):
        vector = bytes(STORE.serialize_cdr(VECTOR(float(index), 0.0, 1.0), VECTOR.__msgtype__))
        writer.write(vectors, vector, 1_000 + index, 500 + index)
        number = bytes(STORE.serialize_cdr(FLOAT(float(index)), FLOAT.__msgtype__))
        writer.write(floats, number, 1_000 + index, 500 + index)
        written += [vector, number]
    writer.close()
    return written


def test_rosbags_reads_what_was_written(tmp_path):
    written = _write(tmp_path / "bag")
    with AnyReader([tmp_path / "bag"]) as reader:
        read = [bytes(raw) for _, _, raw in reader.messages()]
        assert reader.message_count == 100
        assert reader.start_time == 1_000
        assert {c.topic: c.msgtype for c in reader.connections} == {
            "/vector": "geometry_msgs/msg/Vector3",
            "/float": "std_msgs/msg/Float64",
        }
    assert read == written


def test_mcap_reads_index_and_statistics(tmp_path):
    _write(tmp_path / "bag")
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
        assert summary is not None
        assert summary.statistics.message_count == 100
        assert sorted(summary.statistics.channel_message_counts.values()) == [50, 50]
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}


@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("compression", ["none", "zstd"])
@pytest.mark.parametrize("limits", [Limits(), Limits(duration=20)], ids=["one file", "split"])
def test_a_strict_reader_finds_every_file_right(tmp_path, compression, limits, background):
    _write(tmp_path / "bag", compression=compression, limits=limits, background=background)
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    files = information["rosbag2_bagfile_information"]["files"]
    assert len(files) == (3 if limits.duration else 1)
    decoded: dict[str, list[float]] = {"/vector": [], "/float": []}
    for file in files:
        with (tmp_path / "bag" / file["path"]).open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            _check_file(reader, file, decoded)
    assert decoded == {topic: [float(index) for index in range(50)] for topic in decoded}


def _check_file(reader, file: dict, decoded: dict[str, list[float]]) -> None:
    """Compare a file's summary with its messages and with metadata.yaml; decode the messages."""
    summary = reader.get_summary()
    statistics = summary.statistics
    counts: dict[int, int] = {}
    times = []
    for schema, channel, message, content in reader.iter_decoded_messages():
        assert summary.channels[channel.id] == channel
        assert summary.schemas[schema.id] == schema
        counts[channel.id] = counts.get(channel.id, 0) + 1
        times.append(message.log_time)
        decoded[channel.topic].append(content.x if channel.topic == "/vector" else content.data)
    assert statistics.channel_message_counts == counts
    assert statistics.message_count == len(times) == file["message_count"]
    start = file["starting_time"]["nanoseconds_since_epoch"]
    assert statistics.message_start_time == min(times) == start
    assert statistics.message_end_time == max(times) == start + file["duration"]["nanoseconds"]
    assert statistics.schema_count == len(summary.schemas) == 2
    assert statistics.channel_count == len(summary.channels) == 2
    assert statistics.chunk_count == len(summary.chunk_indexes)


def test_metadata_is_whole_before_the_end(tmp_path):
    writer = BagWriter(tmp_path / "bag")
    writer.add_topic("/vector", "geometry_msgs/msg/Vector3")
    writer.flush()
    content = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())
    information = content["rosbag2_bagfile_information"]
    assert information["storage_identifier"] == "mcap"
    topics = information["topics_with_message_count"]
    assert [topic["topic_metadata"]["name"] for topic in topics] == ["/vector"]
    writer.close()


def test_times_that_go_back_are_held(tmp_path):
    writer = BagWriter(tmp_path / "bag")
    topic = writer.add_topic("/float", "std_msgs/msg/Float64")
    message = bytes(STORE.serialize_cdr(FLOAT(1.0), FLOAT.__msgtype__))
    for log_time in (5, 3, 7):
        writer.write(topic, message, log_time, log_time)
    writer.close()
    with AnyReader([tmp_path / "bag"]) as reader:
        assert [time for _, time, _ in reader.messages()] == [5, 5, 7]


def test_refusals(tmp_path):
    _write(tmp_path / "bag", 1)
    with pytest.raises(BagExistsError, match="exists already: choose another name"):
        BagWriter(tmp_path / "bag")
    with pytest.raises(FileError, match="cannot be made"):
        BagWriter(tmp_path / "bag" / "bag_0.mcap" / "inside")
    with pytest.raises(UnknownTypeError, match="unknown type nobody_msgs/msg/Nothing"):
        BagWriter(tmp_path / "other").add_topic("/x", "nobody_msgs/msg/Nothing")


@pytest.fixture
def share(tmp_path, monkeypatch) -> FilePath:
    """Return a folder that is the only one where packages are installed."""
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path / 'nothing'}:{tmp_path}")
    monkeypatch.setattr("sys.prefix", str(tmp_path / "none"))
    type_text.cache_clear()
    yield tmp_path / "share"
    type_text.cache_clear()


def _install(share: FilePath, name: str, text: str) -> None:
    package, _, message = name.split("/")
    file = share / package / "msg" / f"{message}.msg"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)


LINE = "=" * 80


def test_definitions_are_the_installed_ones_as_rosbag2_joins_them(tmp_path, share):
    _install(share, "own_msgs/msg/Leg", "# A leg.\nuint8 LEFT=0\nfloat64 length 1.5  # in m\n")
    _install(share, "own_msgs/msg/Dog", "Leg[4] legs\nLeg[] spare\nother_msgs/Name name\n")
    _install(share, "other_msgs/msg/Name", "string<=10 text")
    text = type_text("own_msgs/msg/Dog")
    assert text.definition == (
        "Leg[4] legs\nLeg[] spare\nother_msgs/Name name\n"
        f"\n{LINE}\nMSG: other_msgs/Name\nstring<=10 text"
        f"\n{LINE}\nMSG: own_msgs/Leg\n# A leg.\nuint8 LEFT=0\nfloat64 length 1.5  # in m\n"
    )
    assert text.type_hash.startswith("RIHS01_")
    writer = BagWriter(tmp_path / "bag")
    topic = writer.add_topic("/dog", "own_msgs/msg/Dog")
    message = bytes([0, 1, 0, 0]) + bytes(32) + bytes(4) + bytes([3, 0, 0, 0]) + b"ab\0"
    writer.write(topic, message, 1, 1)
    writer.close()
    with AnyReader([tmp_path / "bag"]) as reader:
        ((connection, _, raw),) = reader.messages()
        assert reader.deserialize(raw, connection.msgtype).name.text == "ab"


def test_types_that_are_not_installed_are_those_of_jazzy(share):
    text = type_text("geometry_msgs/msg/PoseStamped")
    assert "MSG: geometry_msgs/Quaternion" in text.definition
    assert text.type_hash == STORE.hash_rihs01("geometry_msgs/msg/PoseStamped")


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("own_msgs/msg/Missing", "no installed package has the file share/own_msgs/msg/Missing"),
        ("own_msgs/msg/Incomplete", "has the file share/own_msgs/msg/Missing.msg"),
        ("own_msgs/msg/Broken", "unknown type own_msgs/msg/Broken"),
        ("own_msgs/srv/Call_Event", "only types named PACKAGE/msg/NAME can be recorded"),
        ("own_msgs/msg/../../x", "only types named PACKAGE/msg/NAME can be recorded"),
    ],
)
def test_types_without_a_definition_are_refused_in_a_sentence(share, name, reason):
    _install(share, "own_msgs/msg/Incomplete", "Missing item")
    _install(share, "own_msgs/msg/Broken", "this is { no definition")
    with pytest.raises(UnknownTypeError, match=reason) as raised:
        type_text(name)
    assert "\n" not in str(raised.value)


def test_installed_and_jazzys_definitions_have_the_same_hash():
    for name in ("nav_msgs/msg/Odometry", "diagnostic_msgs/msg/DiagnosticArray"):
        assert type_text(name).type_hash == STORE.hash_rihs01(name)


@pytest.mark.parametrize("content", [b"", b"not a bag", bytes(range(256)) * 10])
def test_reading_what_is_no_bag(tmp_path, content):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_bytes(content)
    with pytest.raises(FileError, match="cannot be read"):
        read_run(tmp_path / "bag")
    with pytest.raises(FileError, match="does not exist"):
        read_run(tmp_path / "missing")
