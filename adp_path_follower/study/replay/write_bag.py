"""Writes the outcome of a replay as a bag, which is analysed like any other."""

import heapq
import math
from collections.abc import Iterator, Mapping
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from adp_path_follower.bags.reader import messages_of
from adp_path_follower.bags.topics import SERIES, TYPES
from adp_path_follower.bags.writer import BagWriter
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.messages.raw import stamped_numbers
from adp_path_follower.study.replay.replay import Replay

_NODE = "/path_follower"
_NOT_TOLD = ("ground_truth", "robot_model")  # by a replay, of the series that a bag may have
_KINDS = {
    f"{'' if key in ('odom', 'cmd_vel') else _NODE}/{key}": kinds[0]
    for key, kinds in SERIES.items()
    if key not in _NOT_TOLD
}
_KINDS[f"{_NODE}/configuration"] = TYPES["configuration"][0]
# Topics of the recorded run that stay as they are.
_COPIED = ("odom", "path", "goal_path", "ground_truth", "initial_weights")
_TRANSFORMS = "tf2_msgs/msg/TFMessage"

# Arrival [ns], topic, serialised message.
_Entry = tuple[int, str, bytes]


def write_replay(
    found: Replay,
    source: FilePath,
    topics: Mapping[str, str],
    bag: FilePath,
    velocity: FloatArray | None = None,
) -> None:
    """Write a bag with the replay's commands and learner topics beside the recorded odometry.

    `topics` maps "odom", "path" and others to be copied to their topics in `source`; `velocity` is
    v, w at each step (N, 2) of a closed loop, whose odometry then replaces the recorded one. Raises
    FileError if `bag` exists or cannot be made.
    """
    gone = ("odom", "ground_truth") if velocity is not None else ()
    kinds = {topics[key]: TYPES[key][0] for key in _COPIED if key in topics and key not in gone}
    numbers: dict[str, int] = {}

    def wanted(topic: str, kind: str) -> bool:
        """Return whether a topic is copied; it is added before its first message is read."""
        known = kinds.get(topic) == kind or (kind == _TRANSFORMS and velocity is None)
        if known and topic not in numbers:
            numbers[topic] = writer.add_topic(topic, kind)
        return known

    writer = BagWriter(bag, {"replay_of": source.name}, chunked=True)
    for topic, kind in _KINDS.items():
        if topic != "/odom" or velocity is not None:
            numbers[topic] = writer.add_topic(topic, kind)
    recorded = messages_of(source, wanted)
    for arrival, topic, message in heapq.merge(recorded, _replayed(found, velocity)):
        writer.write(numbers[topic], message, arrival, arrival)
    writer.close()


def _replayed(found: Replay, velocity: FloatArray | None) -> Iterator[_Entry]:
    """Yield the messages that the nodes would have published, step by step."""
    store = get_typestore(Stores.ROS2_JAZZY)
    said, arrival = dict(found.configurations), int(found.steps.arrival[0])
    label = ", ".join(found.settings.learning.value_basis.labels)
    for step, output in enumerate(found.outputs):
        arrival = max(arrival, int(found.steps.arrival[step]))
        stamp, pose = int(found.steps.stamp[step]), found.steps.pose[step]
        if step in said:
            yield arrival, f"{_NODE}/configuration", _bytes(store, "String", data=said[step])
        if velocity is not None:
            zeros = (0.0,) * 36  # the covariances
            motion = (*_pose(pose), *zeros, *_twist(velocity[step]), *zeros)
            yield arrival, "/odom", stamped_numbers(stamp, "odom", motion, "base_link")
        for topic, numbers in (
            ("/cmd_vel", _twist(output.command)),
            (f"{_NODE}/measured_pose", pose),
            (f"{_NODE}/measured_motion", found.steps.motion[step]),
            (f"{_NODE}/tracking_error", output.error),
            (f"{_NODE}/target", _pose(output.target_pose)),
        ):
            yield arrival, topic, stamped_numbers(stamp, "odom", numbers)
        for name, weights in (("critic", output.weights.critic), ("actor", output.weights.actor)):
            yield arrival, f"{_NODE}/{name}_weights", _array(store, label, weights)
        for name, value in (
            ("bellman_error", output.bellman_error),
            ("excitation", output.excitation),
            ("cost", found.cost[step]),
        ):
            yield arrival, f"{_NODE}/{name}", _bytes(store, "Float64", data=float(value))


def _pose(pose: FloatArray) -> tuple[float, ...]:
    x, y, theta = pose.tolist()
    return (x, y, 0.0, 0.0, 0.0, math.sin(0.5 * theta), math.cos(0.5 * theta))


def _twist(command: FloatArray) -> tuple[float, ...]:
    v, w = command.tolist()
    return (v, 0.0, 0.0, 0.0, 0.0, w)


def _array(store: Typestore, label: str, values: FloatArray) -> bytes:
    """Return a row of numbers as a message, with the label that names them."""
    size = len(values)
    dimension = _make(store, "MultiArrayDimension", label=label, size=size, stride=size)
    layout = _make(store, "MultiArrayLayout", dim=[dimension], data_offset=0)
    return _bytes(store, "Float64MultiArray", layout=layout, data=np.asarray(values))


def _make(store: Typestore, kind: str, **fields: Any) -> Any:
    return store.types[f"std_msgs/msg/{kind}"](**fields)


def _bytes(store: Typestore, kind: str, **fields: Any) -> bytes:
    message = _make(store, kind, **fields)
    return bytes(store.serialize_cdr(message, f"std_msgs/msg/{kind}"))
