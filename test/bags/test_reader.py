"""Bags of every kind that ROS 2 users have, read into numbers."""

from __future__ import annotations

import contextlib
import re
import shutil
import sqlite3

import numpy as np
import pytest
import yaml
from mcap.writer import Writer as Mcap
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from adp_path_follower.analysis.recorded_run import drive_of
from adp_path_follower.bags.columns import KINDS, MessageDecoder
from adp_path_follower.bags.reader import read_run
from adp_path_follower.bags.writer import BagWriter
from adp_path_follower.core.errors import FileError
from bag_messages import (
    SECOND,
    STORE,
    array,
    diagnostics,
    odometry,
    path_message,
    raw,
    text,
    twist,
    twist_stamped,
    write_bag,
    write_foreign,
)


def small_run(stamped: bool = True):
    """Return the messages of a short run: ten poses on a line, each with its command."""
    yield "/path", 0, path_message([(float(x), 0.0) for x in range(5)])
    for step in range(10):
        time = SECOND + step * SECOND // 10
        yield "/odom", time, odometry(time, 0.1 * step, 0.5, 0.25, 1.0, -0.5)
        command = twist_stamped(time, 1.0, 0.1 * step) if stamped else twist(1.0, 0.1 * step)
        yield "/cmd_vel", time + 1000, command


STORAGES = {
    "mcap": {},
    "sqlite3": {"storage": StoragePlugin.SQLITE3},
    "sqlite3 messages": {
        "storage": StoragePlugin.SQLITE3,
        "compression": CompressionMode.MESSAGE,
    },
    "sqlite3 file": {"storage": StoragePlugin.SQLITE3, "compression": CompressionMode.FILE},
    "mcap chunks": {"compression": CompressionMode.STORAGE},
    "mcap messages": {"compression": CompressionMode.MESSAGE},
    "mcap file": {"compression": CompressionMode.FILE},
}


@pytest.mark.parametrize("stamped", [True, False], ids=["TwistStamped", "Twist"])
@pytest.mark.parametrize("kind", STORAGES)
def test_every_kind_of_bag_gives_the_same_numbers(tmp_path, kind, stamped):
    bag = write_foreign(tmp_path / "bag", small_run(stamped), **STORAGES[kind])
    run = read_run(bag)
    odom, commands = run.series["odom"], run.series["cmd_vel"]
    assert odom.values == pytest.approx(
        np.column_stack([0.1 * np.arange(10), *np.tile([[0.5], [0.25], [1.0], [-0.5]], 10)])
    )
    assert odom.stamp.tolist() == [SECOND + step * SECOND // 10 for step in range(10)]
    assert commands.values == pytest.approx(np.column_stack([np.ones(10), 0.1 * np.arange(10)]))
    late = 0 if stamped else 1000
    assert commands.stamp.tolist() == (odom.stamp + late).tolist()
    assert (commands.arrival - odom.arrival).tolist() == [1000] * 10
    assert run.paths[-1][1][:, :2].tolist() == [[float(x), 0.0] for x in range(5)]
    assert run.message_counts == {"/path": 1, "/odom": 10, "/cmd_vel": 10}
    assert run.notes == ()


def test_a_split_bag_is_read_as_one(tmp_path):
    """Two files under one metadata.yaml, as rosbag2 splits a long recording."""
    messages = list(small_run())
    first = write_foreign(tmp_path / "first", messages[:11])
    second = write_foreign(tmp_path / "second", messages[11:])
    content = yaml.safe_load((first / "metadata.yaml").read_text())
    information = content["rosbag2_bagfile_information"]
    (second / "second.mcap").rename(first / "second.mcap")
    information["relative_file_paths"].append("second.mcap")
    information["message_count"] = len(messages)
    (first / "metadata.yaml").write_text(yaml.safe_dump(content))
    run = read_run(first)
    assert run.series["odom"].values[:, 0] == pytest.approx(0.1 * np.arange(10))


def test_one_file_without_its_directory(tmp_path):
    bag = write_bag(tmp_path / "bag", small_run())
    assert len(read_run(bag / "bag_0.mcap").series["odom"].stamp) == 10


def test_other_topic_names(tmp_path):
    names = {"/odom": "/base/filtered", "/cmd_vel": "/nav/command", "/path": "/plan"}
    messages = [(names[topic], time, message) for topic, time, message in small_run()]
    bag = write_bag(tmp_path / "bag", messages)
    alone = read_run(bag)  # each is the only one of its type
    assert set(alone.series) == {"odom", "cmd_vel"}
    assert (
        alone.notes[0]
        == "no topic is named odom: /base/filtered was taken, the only one of its type"
    )
    other = [("/other", 1, messages[1][2])]
    bag_of_two = write_bag(tmp_path / "two", sorted([*messages, *other], key=lambda item: item[1]))
    assert "odom" not in read_run(bag_of_two).series
    given = {"odom": "base/filtered", "cmd_vel": "/nav/command", "path": "plan"}
    run = read_run(bag, given)
    assert set(run.series) == {"odom", "cmd_vel"}
    assert len(run.paths[-1][1]) == 5
    with pytest.raises(FileError, match=r"no topic /odometry; of a type that fits.*/base/filtered"):
        read_run(bag, {"odom": "odometry"})
    with pytest.raises(FileError, match=r"topic /plan .* has the type nav_msgs/msg/Path, but must"):
        read_run(bag, {"odom": "plan"})


def test_two_robots_need_a_name(tmp_path):
    messages = [
        (f"{robot}{topic}", time, message)
        for topic, time, message in small_run()
        for robot in ("/a", "/b")
    ]
    bag = write_bag(tmp_path / "bag", messages)
    with pytest.raises(FileError, match="several topics named odom: say which by --odom"):
        read_run(bag)
    names = {"odom": "/b/odom", "cmd_vel": "/b/cmd_vel", "path": "/b/path"}
    assert read_run(bag, names).topics["odom"] == "/b/odom"


def test_types_that_do_not_fit_are_passed_over_with_a_note(tmp_path):
    wrong = [("/ground_truth", 0, text("here")), ("/diagnostics", 1, text("fine"))]
    run = read_run(write_bag(tmp_path / "bag", [*wrong, *small_run()]))
    assert "ground_truth" not in run.series
    assert sorted(note.split(" has ")[0] for note in run.notes) == [
        "topic /diagnostics",
        "topic /ground_truth",
    ]


def test_unknown_types_are_passed_over_with_a_note(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("float64 secret\n", "nobody_msgs/msg/Nothing"))
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        for number in range(7):
            unknown = writer.add_connection(
                f"/x{number}", "nobody_msgs/msg/Nothing", typestore=store
            )
            writer.write(unknown, 1, b"\0\1\0\0" + bytes(8))
        odom = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
        writer.write(odom, 2, raw(odometry(2, 1.0, 2.0, 0.0)))
    run = read_run(tmp_path / "bag")
    assert run.series["odom"].values[0, :2].tolist() == [1.0, 2.0]
    assert run.message_counts["/x0"] == 1
    (note,) = run.notes
    assert note.startswith("topics of types that are not known here: /x0 (nobody_msgs/msg/Nothing)")
    assert note.endswith(", and 2 more: passed over")


def test_messages_of_changing_lengths_stay_in_order(tmp_path):
    frames = ["odom", "a", "a longer frame", ""]
    messages = [
        ("/odom", step, odometry(step, float(step), 0.0, 0.0, frame=frames[step % 4]))
        for step in range(101)
    ]
    run = read_run(write_bag(tmp_path / "bag", messages))
    assert run.series["odom"].values[:, 0].tolist() == list(range(101))
    assert run.series["odom"].stamp.tolist() == list(range(101))


def test_broken_messages_are_left_out_and_counted(tmp_path):
    writer = BagWriter(tmp_path / "bag")
    topic = writer.add_topic("/odom", "nav_msgs/msg/Odometry")
    good = raw(odometry(5, 1.0, 2.0, 0.5))
    huge = bytearray(good)
    huge[12:16] = b"\xff\xff\xff\xff"  # the length of the frame's name
    for content in (good, good[:50], bytes(huge), b"", good):
        writer.write(topic, content, 1, 1)
    writer.close()
    run = read_run(tmp_path / "bag")
    assert run.series["odom"].values[:, 0].tolist() == [1.0, 1.0]
    assert run.notes == ("topic /odom: 3 of 5 messages cannot be decoded: passed over",)


def damaged_bag(directory, damage):
    """Write a bag in which the first of several messages on some topics is damaged."""
    writer = BagWriter(directory)
    wholes = {
        "/odom": odometry(5, 1.0, 2.0, 0.5),
        "/path": path_message([(0.0, 0.0), (1.0, 0.0)]),
        "/path_follower/configuration": text("settings: {}"),
        "/diagnostics": diagnostics(0, "following"),
    }
    for name, message in wholes.items():
        topic = writer.add_topic(name, message.__msgtype__)
        for number in range(3):
            content = raw(message)
            writer.write(topic, damage(name, number, content), number, number)
    writer.close()
    return directory


def test_damaged_messages_of_any_topic_are_passed_over_and_counted(tmp_path):
    bag = damaged_bag(
        tmp_path / "bag", lambda _, number, content: content if number else content[:9]
    )
    run = read_run(bag)
    assert len(run.series["odom"].stamp) == 2
    assert run.paths[-1][1][:, :2].tolist() == [[0.0, 0.0], [1.0, 0.0]]
    assert run.configuration == "settings: {}"
    assert [item.state for item in run.diagnostics] == ["following"]
    assert set(run.notes) == {
        f"topic {topic}: 1 of 3 messages cannot be decoded: passed over"
        for topic in ("/odom", "/path", "/path_follower/configuration", "/diagnostics")
    }


@pytest.mark.parametrize("topic", ["/odom", "/path"])
def test_a_topic_that_is_needed_and_cannot_be_decoded_is_one_sentence(tmp_path, topic):
    bag = damaged_bag(
        tmp_path / "bag", lambda name, _, content: content[:9] if name == topic else content
    )
    with pytest.raises(FileError, match=f"topic {topic}: none of its 3 messages can be decoded"):
        read_run(bag)


def test_a_topic_that_is_not_needed_and_cannot_be_decoded_is_a_note(tmp_path):
    bag = damaged_bag(
        tmp_path / "bag",
        lambda name, _, content: content[:9] if name == "/diagnostics" else content,
    )
    run = read_run(bag)
    assert run.diagnostics == ()
    assert run.notes == ("topic /diagnostics: 3 of 3 messages cannot be decoded: passed over",)


def test_the_first_array_does_not_decide_the_width_alone(tmp_path):
    topic = "/path_follower/critic_weights"
    messages = [(topic, time, array([1.0] * (1 if time == 1 else 2))) for time in range(1, 6)]
    run = read_run(write_bag(tmp_path / "bag", messages))
    assert run.series["critic_weights"].values.shape == (4, 2)
    assert run.notes == (
        f"topic {topic}: 1 of 5 messages hold another number of values than most: passed over",
    )


def test_arrays_keep_their_labels_and_their_width(tmp_path):
    topic = "/path_follower/critic_weights"
    messages = [(topic, 1, array([1.0, 2.0])), (topic, 2, array([3.0])), (topic, 3, array([4, 5]))]
    run = read_run(write_bag(tmp_path / "bag", messages))
    assert run.series["critic_weights"].labels == ("a", "b")
    assert run.series["critic_weights"].values.tolist() == [[1.0, 2.0], [4.0, 5.0]]
    assert run.series["critic_weights"].stamp.tolist() == [1, 3]


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_numbers_are_read_as_the_library_reads_them(kind, little_endian):
    """Random numbers in every field of every type that is read."""
    random = np.random.default_rng(1)
    decoder = MessageDecoder(KINDS[kind])
    messages, expected = [], []
    for number in range(20):
        message = random_message(kind, random)
        if hasattr(message, "header"):
            message.header.stamp.sec, message.header.stamp.nanosec = number, 7
            message.header.frame_id = "odom"
        messages.append(bytes(STORE.serialize_cdr(message, kind, little_endian=little_endian)))
        expected.append([number_of(message, name) for name in READ[kind]])
    ((chosen, stamps, values),) = decoder.decode(messages)
    assert chosen.tolist() == list(range(20))
    has_header = KINDS[kind].texts > 0
    assert stamps.tolist() == [(number * SECOND + 7) * has_header for number in range(20)]
    assert values.tolist() == expected
    assert decoder.text(messages[0]) == ("odom" if has_header else "")


def random_message(kind, random):
    """Return a message of the library's type with random numbers in all fields."""
    found = {}
    for name, (node, content) in STORE.fielddefs[kind][1]:
        if node == Nodetype.NAME:
            found[name] = random_message(content, random)
        elif node == Nodetype.ARRAY:
            found[name] = random.normal(size=content[1])
        elif node == Nodetype.SEQUENCE:
            found[name] = random.normal(size=5) if name == "data" else []
        else:
            found[name] = {"string": "base_link", "float64": random.normal()}.get(content[0], 0)
    return STORE.types[kind](**found)


def number_of(message, name):
    """Return a number of a message, as "twist.linear.x", or "data.3" of a sequence."""
    for part in name.split("."):
        message = message[int(part)] if part.isdigit() else getattr(message, part)
    return message


POSE = ("position.x", "position.y", *(f"orientation.{axis}" for axis in "xyzw"))
TWIST = ("linear.x", "angular.z")
READ = {
    "nav_msgs/msg/Odometry": (
        *(f"pose.pose.{name}" for name in POSE),
        *(f"twist.twist.{name}" for name in TWIST),
    ),
    "geometry_msgs/msg/PoseStamped": tuple(f"pose.{name}" for name in POSE),
    "geometry_msgs/msg/Vector3Stamped": ("vector.x", "vector.y", "vector.z"),
    "geometry_msgs/msg/TwistStamped": tuple(f"twist.{name}" for name in TWIST),
    "geometry_msgs/msg/Twist": TWIST,
    "std_msgs/msg/Float64": ("data",),
    "std_msgs/msg/Float64MultiArray": tuple(f"data.{place}" for place in range(5)),
}


def test_progress_is_reported(tmp_path):
    seen: list[float] = []
    read_run(write_bag(tmp_path / "bag", small_run()), progress=seen.append)
    assert seen[0] == 0.0


# Bags as recorders leave them


def test_messages_of_an_sqlite3_log_are_read_and_the_bag_stays_as_it_is(tmp_path):
    """A recorder that was killed leaves most messages in the write-ahead log."""
    kind = {"storage": StoragePlugin.SQLITE3}
    messages = list(small_run())
    whole = write_foreign(tmp_path / "whole", messages, **kind)
    bag = write_foreign(tmp_path / "bag", messages[:6], **kind)
    with (
        contextlib.closing(sqlite3.connect(whole / "whole.db3")) as source,
        contextlib.closing(sqlite3.connect(bag / "bag.db3")) as base,
    ):
        rows = source.execute("SELECT topic_id, timestamp, data FROM messages").fetchall()
        base.execute("PRAGMA journal_mode=WAL")
        base.execute("PRAGMA wal_autocheckpoint=0")
        base.executemany(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows[6:]
        )
        base.commit()
        torn = tmp_path / "torn" / "bag"
        shutil.copytree(bag, torn)  # while it is open
    before = {file.name: file.read_bytes() for file in torn.iterdir()}
    assert len(before["bag.db3-wal"]) > 0
    run = read_run(torn)
    assert run.message_counts == {"/path": 1, "/odom": 10, "/cmd_vel": 10}
    assert any("-wal" in note for note in run.notes)
    assert {file.name: file.read_bytes() for file in torn.iterdir()} == before
    assert read_run(torn / "bag.db3").message_counts == run.message_counts


def test_of_two_types_on_a_topic_the_more_frequent_is_read_and_the_other_counted(tmp_path):
    messages = list(small_run())
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        known = {}
        others = [("/cmd_vel", SECOND + n, twist(9.0, 9.0)) for n in range(3)]
        for topic, time, message in [*others, *messages]:
            key = topic, message.__msgtype__
            if key not in known:
                known[key] = writer.add_connection(*key, typestore=STORE)
            writer.write(known[key], time, raw(message))
    run = read_run(tmp_path / "bag")
    assert run.series["cmd_vel"].values[:, 0].tolist() == [1.0] * 10
    assert run.notes == (
        "topic /cmd_vel: 3 messages are geometry_msgs/msg/Twist, not "
        "geometry_msgs/msg/TwistStamped as the others: left out",
    )


@pytest.mark.parametrize(
    ("profile", "encoding", "words"),
    [
        ("ros1", "ros1msg", "convert one of ROS 1 with `rosbags-convert"),
        ("", "ros2msg", "one of another tool with `adp recover`"),
    ],
)
def test_files_of_other_kinds_are_one_sentence(tmp_path, profile, encoding, words):
    file = tmp_path / "other.mcap"
    with file.open("wb") as stream:
        writer = Mcap(stream)
        writer.start(profile=profile, library="another tool")
        schema = writer.register_schema("nav_msgs/msg/Odometry", encoding, b"float64 x")
        writer.add_message(writer.register_channel("/odom", "cdr", schema), 1, b"nothing", 1)
        writer.finish()
    with pytest.raises(FileError, match=re.escape(words)):
        read_run(file)
    old = tmp_path / "old.bag"
    old.write_bytes(b"#ROSBAG V2.0\n")
    with pytest.raises(FileError, match="no bag of ROS 2: convert one of ROS 1"):
        read_run(old)


def mcap_of_encodings(file, encodings, others=()):
    """Write a short run; topics have the encodings (definition, messages) given for them."""
    with file.open("wb") as stream:
        writer, channels = Mcap(stream), {}
        writer.start(profile="ros2", library="another tool")
        for topic, kind, definition, data, encoding in others:
            schema = writer.register_schema(kind, definition, data) if kind else 0
            writer.add_message(writer.register_channel(topic, encoding, schema), 1, b"{}", 1)
        for topic, time, message in small_run():
            if topic not in channels:
                definition, encoding = encodings.get(topic, ("ros2msg", "cdr"))
                text, _ = STORE.generate_msgdef(message.__msgtype__, ros_version=2)
                schema = writer.register_schema(message.__msgtype__, definition, text.encode())
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], time, raw(message), time)
        writer.finish()


def test_topics_in_other_encodings_are_left_out_with_a_note(tmp_path):
    others = [
        ("/json", "cam", "jsonschema", b"{}", "json"),
        ("/proto", "foxglove.Image", "protobuf", bytes([0x0A, 0xFF, 0xC3, 0x28]), "protobuf"),
        ("/bare", "", "", b"", "json"),
        ("/odom", "nav_msgs/msg/Odometry", "jsonschema", b"{}", "json"),
    ]
    mcap_of_encodings(tmp_path / "others.mcap", {"/cmd_vel": ("protobuf", "protobuf")}, others)
    run = read_run(tmp_path / "others.mcap")
    assert len(run.series["odom"].stamp) == 10
    assert "cmd_vel" not in run.series
    assert "/odom: 1 messages are nav_msgs/msg/Odometry in json, not nav_msgs" in run.notes[0]
    assert "/cmd_vel has the type geometry_msgs/msg/TwistStamped in protobuf" in run.notes[1]
    for named in ("/json (cam in json)", "/proto (foxglove.Image in protobuf)", "/bare (", "/odom"):
        assert named in run.notes[-1]
    assert run.message_counts["/proto"] == 1


def test_a_needed_topic_in_another_encoding_is_named(tmp_path):
    mcap_of_encodings(tmp_path / "json.mcap", {"/odom": ("jsonschema", "json")})
    with pytest.raises(FileError, match=r"no odometry.*/odom has the type .*Odometry in json"):
        drive_of(tmp_path, read_run(tmp_path / "json.mcap"))


def test_the_files_of_a_bag_say_which_topics_it_has(tmp_path):
    """A topic in json, and one that an older metadata.yaml does not know."""
    bag = write_bag(tmp_path / "bag", small_run())
    others = [("/json", "cam", "jsonschema", b"{}", "json")]
    mcap_of_encodings(bag / "bag_0.mcap", {}, others)
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    topics = metadata["rosbag2_bagfile_information"]["topics_with_message_count"]
    topics[0]["topic_metadata"]["serialization_format"] = "json"
    del topics[1:]
    (bag / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    run = read_run(bag)
    assert len(run.series["odom"].stamp) == len(run.series["cmd_vel"].stamp) == 10
    assert run.notes == (
        "topics of types that are not known here: /json (cam in json): passed over",
    )


def test_a_folder_that_holds_a_bag_means_that_bag(tmp_path):
    write_bag(tmp_path / "demo" / "bag", small_run())
    run = read_run(tmp_path / "demo")
    assert len(run.series["odom"].stamp) == 10
    assert run.notes == (f"the bag in {tmp_path / 'demo'} is bag: it was read",)
    write_bag(tmp_path / "demo" / "other", small_run())
    with pytest.raises(FileError, match="holds several bags: give one of bag, other"):
        read_run(tmp_path / "demo")
