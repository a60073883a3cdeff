"""Bags whose own definition of a type is not that of ROS 2 Jazzy."""

from __future__ import annotations

import re

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from adp_path_follower.bags.reader import read_run
from adp_path_follower.bags.transforms import read_transforms
from adp_path_follower.core.errors import FileError
from bag_messages import SECOND, STORE, drive_along, raw, transform, write_foreign

HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"
ODOMETRY = "std_msgs/Header header\nstring child_frame_id\n"
STORAGES = [StoragePlugin.MCAP, StoragePlugin.SQLITE3]


def other_store(kind, changes):
    """Return the types in a definition of `kind` in which texts are replaced by others."""
    text, _ = STORE.generate_msgdef(kind, ros_version=2)
    for old, new in changes:
        text = text.replace(old, new)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, kind))
    return store


def moved_to(store, message):
    """Return a message as one of another store: fields of the same name, others as 7 or empty."""
    kind = message.__msgtype__
    values = {}
    for name, (_, content) in store.fielddefs[kind][1]:
        value = getattr(message, name, 7.0 if content == ("float64", 0) else 7)
        if hasattr(value, "__msgtype__"):
            value = moved_to(store, value)
        elif isinstance(value, np.ndarray):
            value = value.astype(content[0][1][0])
        elif isinstance(value, list):
            value = [moved_to(store, item) for item in value]
        values[name] = value
    return store.types[kind](**values)


def write_otherwise(directory, messages, changes, storage):
    """Write messages as a distribution of ROS does whose definitions have these changes."""
    with Writer(directory, version=9, storage_plugin=storage) as writer:
        stores, connections = {}, {}
        for topic, time, message in messages:
            kind = message.__msgtype__
            if topic not in stores:
                stores[topic] = other_store(kind, changes)
                connections[topic] = writer.add_connection(topic, kind, typestore=stores[topic])
            store = stores[topic]
            content = store.serialize_cdr(moved_to(store, message), kind)
            writer.write(connections[topic], time, bytes(content))
    return directory


def some_drive():
    time = np.linspace(0.0, 4.0, 201)
    poses = np.column_stack([0.5 * time, 0.1 * np.sin(time), 0.1 * np.cos(time)])
    return drive_along(poses, [(0.0, 0.0), (1.0, 0.2), (2.0, 0.0)])


def assert_same(found, expected):
    assert found.series.keys() == expected.series.keys()
    for key, series in found.series.items():
        np.testing.assert_array_equal(series.values, expected.series[key].values)
        np.testing.assert_array_equal(series.stamp, expected.series[key].stamp)
    np.testing.assert_array_equal(found.paths[0][1], expected.paths[0][1])


READABLE = {
    "a number in the header": [(HEADER, f"uint32 seq\n{HEADER}")],
    "a header without frame": [(HEADER, "builtin_interfaces/Time stamp\n")],
    "fields in another order": [(ODOMETRY, "string child_frame_id\nstd_msgs/Header header\n")],
    "an own number in between": [(ODOMETRY, f"{ODOMETRY}float64 quality\n")],
    "an own number behind": [("WithCovariance twist\n", "WithCovariance twist\nint8 q\n")],
    "no covariances": [("float64[36] covariance\n", "")],
    "numbers of 32 bits": [("float64[36] covariance\n", "float32[36] covariance\n")],
}  # fmt: skip


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("name", READABLE)
def test_messages_are_read_by_the_definition_in_the_bag(tmp_path, name, storage):
    changes = READABLE[name]
    expected = read_run(write_foreign(tmp_path / "jazzy", some_drive()))
    found = read_run(write_otherwise(tmp_path / "other", some_drive(), changes, storage))
    assert_same(found, expected)
    assert not found.notes


REFUSED = {
    "nav_msgs/msg/Odometry without the field 'pose'": [
        ("PoseWithCovariance pose\n", "PoseWithCovariance where\n")
    ],
    "geometry_msgs/msg/Quaternion without the field 'w'": [("float64 w\n", "")],
    "the field 'x' of geometry_msgs/msg/Point as text, not as number": [
        ("geometry_msgs/Point\nfloat64 x", "geometry_msgs/Point\nstring x")
    ],
}


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("problem", REFUSED)
def test_a_needed_field_that_is_missing_is_one_sentence(tmp_path, problem, storage):
    with Writer(tmp_path / "bag", version=9, storage_plugin=storage) as writer:
        store = other_store("nav_msgs/msg/Odometry", REFUSED[problem])
        odom = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=store)
        writer.write(odom, 1, raw(some_drive()[1][2]))
    expected = f"topic /odom cannot be read: the bag defines {problem}; convert the bag"
    with pytest.raises(FileError, match=re.escape(expected)):
        read_run(tmp_path / "bag")


def test_commands_without_what_is_needed_are_passed_over_with_a_note(tmp_path):
    changes = [("Vector3 angular\n", "Vector3 turning\n")]
    commands = [item for item in some_drive() if item[0] == "/cmd_vel"]
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kind = "geometry_msgs/msg/TwistStamped"
        topic = writer.add_connection("/cmd_vel", kind, typestore=other_store(kind, changes))
        odom = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=STORE)
        writer.write(topic, 1, raw(commands[0][2]))
        writer.write(odom, 2, raw(some_drive()[1][2]))
    run = read_run(tmp_path / "bag")
    assert "cmd_vel" not in run.series
    (note,) = run.notes
    assert "geometry_msgs/msg/Twist without the field 'angular'" in note
    assert note.endswith(": passed over")


@pytest.mark.parametrize("storage", STORAGES)
def test_transforms_are_read_by_the_definition_in_the_bag(tmp_path, storage):
    moved = [("/tf_static", SECOND, transform(SECOND, "map", "odom", 3.0, -2.0, 0.0))]
    changes = [(HEADER, f"uint32 seq\n{HEADER}")]
    bag = write_otherwise(tmp_path / "bag", moved, changes, storage)
    place = read_transforms(bag).moved(np.zeros((1, 3)), "odom", "map", np.array([SECOND]), True)
    np.testing.assert_array_equal(place, [[3.0, -2.0, 0.0]])


@pytest.mark.parametrize("kind", ["/odom", "/path"])
def test_without_a_definition_messages_of_another_length_are_not_decoded(tmp_path, kind):
    """Distributions before Iron do not write definitions: the layout of the numbers has to fit."""
    changes = [
        (ODOMETRY, f"{ODOMETRY}float64 quality\n"),
        ("PoseStamped[] poses\n", "PoseStamped[] poses\nfloat64 speed\n"),
    ]
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for topic, time, message in some_drive()[:2]:
            store = other_store(message.__msgtype__, changes if topic == kind else [])
            content = store.serialize_cdr(moved_to(store, message), message.__msgtype__)
            own = writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            writer.write(own, time, bytes(content))
    with pytest.raises(FileError, match=f"topic {kind}: none of its 1 messages can be decoded"):
        read_run(tmp_path / "bag")
