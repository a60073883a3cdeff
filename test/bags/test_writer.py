"""Bags that are written here, read by other libraries."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.bags.reader import read_run
from adp_path_follower.bags.writer import BagWriter, UnknownTypeError
from adp_path_follower.core.errors import FileError

STORE = get_typestore(Stores.ROS2_JAZZY)
VECTOR = STORE.types["geometry_msgs/msg/Vector3"]
FLOAT = STORE.types["std_msgs/msg/Float64"]


def _write(directory: Path, count: int = 50) -> list[bytes]:
    writer = BagWriter(directory, {"host": "here"})
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


def test_metadata_is_whole_before_the_end(tmp_path):
    writer = BagWriter(tmp_path / "bag")
    writer.add_topic("/vector", "geometry_msgs/msg/Vector3")
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
    with pytest.raises(FileError, match="exists already: choose another name"):
        BagWriter(tmp_path / "bag")
    with pytest.raises(FileError, match="cannot be made"):
        BagWriter(tmp_path / "bag" / "bag_0.mcap" / "inside")
    with pytest.raises(UnknownTypeError, match="unknown type nobody_msgs/msg/Nothing"):
        BagWriter(tmp_path / "other").add_topic("/x", "nobody_msgs/msg/Nothing")


@pytest.mark.parametrize("content", [b"", b"not a bag", bytes(range(256)) * 10])
def test_reading_what_is_no_bag(tmp_path, content):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_bytes(content)
    with pytest.raises(FileError, match="cannot be read"):
        read_run(tmp_path / "bag")
    with pytest.raises(FileError, match="does not exist"):
        read_run(tmp_path / "missing")
