"""Write what a replay found as a bag, which is analysed like any other."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.bags.writer import BagWriter
from adp_path_follower.core.driving.command_law import FollowerOutput
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.study.replay.replay import Replay

_KINDS = {
    "/odom": "nav_msgs/msg/Odometry",
    "/cmd_vel": "geometry_msgs/msg/TwistStamped",
    "/path_follower/measured_pose": "geometry_msgs/msg/Vector3Stamped",
    "/path_follower/tracking_error": "geometry_msgs/msg/Vector3Stamped",
    "/path_follower/target": "geometry_msgs/msg/PoseStamped",
    "/path_follower/critic_weights": "std_msgs/msg/Float64MultiArray",
    "/path_follower/actor_weights": "std_msgs/msg/Float64MultiArray",
    "/path_follower/bellman_error": "std_msgs/msg/Float64",
    "/path_follower/excitation": "std_msgs/msg/Float64",
    "/path_follower/cost": "std_msgs/msg/Float64",
    "/path_follower/configuration": "std_msgs/msg/String",
}
_COPIED = (
    "odom",
    "path",
    "ground_truth",
    "initial_weights",
)  # of the recorded run, with the bytes that it has

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

    Args:
        found: The replay.
        source: The bag that was replayed.
        topics: "odom", "path" and others to be copied -> their topics in `source`.
        bag: The bag to make.
        velocity: v, w that the robot of a closed loop had at each step, shape (N, 2), whose
            odometry is then written in place of the recorded one.

    Raises:
        FileError: The bag exists or cannot be made.

    """
    copied = [topics[key] for key in _COPIED if key in topics]
    if velocity is not None:
        copied = [topics[key] for key in ("path", "initial_weights") if key in topics]
    writer = BagWriter(bag, {"replay_of": source.name}, chunked=True)
    numbers: dict[str, int] = {}
    with Reader(source) as reader:
        connections = [item for item in reader.connections if item.topic in copied]
        for connection in connections:
            if connection.topic not in numbers:
                numbers[connection.topic] = writer.add_topic(connection.topic, connection.msgtype)
        for topic, kind in _KINDS.items():
            if topic not in numbers and (topic != "/odom" or velocity is not None):
                numbers[topic] = writer.add_topic(topic, kind)
        recorded = _recorded(reader, connections)
        for arrival, topic, message in heapq.merge(recorded, _replayed(found, velocity)):
            writer.write(numbers[topic], message, arrival, arrival)
    writer.close()


def _recorded(reader: Reader, connections: list[Connection]) -> Iterator[_Entry]:
    for connection, arrival, raw in reader.messages(connections) if connections else ():
        yield arrival, connection.topic, bytes(raw)


def _replayed(found: Replay, velocity: FloatArray | None) -> Iterator[_Entry]:
    """Yield what the nodes would have published, step by step."""
    messages = _Messages(found.settings.learning.value_basis.labels)
    said = dict(found.configurations)
    arrival = int(found.steps.arrival[0])
    for step, output in enumerate(found.outputs):
        arrival = max(arrival, int(found.steps.arrival[step]))
        stamp, pose = int(found.stamp[step]), found.pose[step]
        if step in said:
            yield arrival, "/path_follower/configuration", messages.text(said[step])
        if velocity is not None:
            yield arrival, "/odom", messages.odometry(stamp, pose, velocity[step])
        for topic, make in messages.of_step.items():
            yield arrival, topic, make(stamp, pose, output, float(found.cost[step]))


class _Messages:
    """Makes serialised messages, without ROS."""

    def __init__(self, labels: tuple[str, ...]) -> None:
        """Take the names of the weights."""
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._labels = ", ".join(labels)
        self.of_step: dict[str, Callable[[int, FloatArray, FollowerOutput, float], bytes]] = {
            "/cmd_vel": lambda t, pose, out, cost: self._twist_stamped(t, out.command),
            "/path_follower/measured_pose": lambda t, pose, out, cost: self._vector(t, pose),
            "/path_follower/tracking_error": lambda t, pose, out, cost: self._vector(t, out.error),
            "/path_follower/target": lambda t, pose, out, cost: self._target(t, out.target_pose),
            "/path_follower/critic_weights": lambda t, pose, out, cost: self._array(
                out.weights.critic
            ),
            "/path_follower/actor_weights": lambda t, pose, out, cost: self._array(
                out.weights.actor
            ),
            "/path_follower/bellman_error": lambda t, pose, out, cost: self._number(
                out.bellman_error
            ),
            "/path_follower/excitation": lambda t, pose, out, cost: self._number(out.excitation),
            "/path_follower/cost": lambda t, pose, out, cost: self._number(cost),
        }

    def text(self, text: str) -> bytes:
        """Return a std_msgs/String."""
        return self._bytes("std_msgs/msg/String", data=text)

    def odometry(self, stamp: int, pose: FloatArray, velocity: FloatArray) -> bytes:
        """Return odometry of a pose (3,) and v, w (2,)."""
        zeros = np.zeros(36)
        return self._bytes(
            "nav_msgs/msg/Odometry",
            header=self._header(stamp),
            child_frame_id="base_link",
            pose=self._make(
                "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(pose), covariance=zeros
            ),
            twist=self._make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._twist(velocity),
                covariance=zeros,
            ),
        )

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _bytes(self, kind: str, **fields: Any) -> bytes:
        return bytes(self._store.serialize_cdr(self._make(kind, **fields), kind))

    def _header(self, stamp: int) -> Any:
        seconds, nanoseconds = divmod(stamp, 1_000_000_000)
        time = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self._make("std_msgs/msg/Header", stamp=time, frame_id="odom")

    def _vector3(self, x: float, y: float, z: float) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))

    def _twist(self, command: FloatArray) -> Any:
        return self._make(
            "geometry_msgs/msg/Twist",
            linear=self._vector3(command[0], 0.0, 0.0),
            angular=self._vector3(0.0, 0.0, command[1]),
        )

    def _pose(self, pose: FloatArray) -> Any:
        half = 0.5 * float(pose[2])
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make(
                "geometry_msgs/msg/Point", x=float(pose[0]), y=float(pose[1]), z=0.0
            ),
            orientation=self._make(
                "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(half), w=math.cos(half)
            ),
        )

    def _twist_stamped(self, stamp: int, command: FloatArray) -> bytes:
        return self._bytes(
            "geometry_msgs/msg/TwistStamped",
            header=self._header(stamp),
            twist=self._twist(command),
        )

    def _vector(self, stamp: int, values: FloatArray) -> bytes:
        return self._bytes(
            "geometry_msgs/msg/Vector3Stamped",
            header=self._header(stamp),
            vector=self._vector3(*values.tolist()),
        )

    def _target(self, stamp: int, pose: FloatArray) -> bytes:
        return self._bytes(
            "geometry_msgs/msg/PoseStamped", header=self._header(stamp), pose=self._pose(pose)
        )

    def _number(self, value: Any) -> bytes:
        return self._bytes("std_msgs/msg/Float64", data=float(value))

    def _array(self, values: FloatArray) -> bytes:
        dimension = self._make(
            "std_msgs/msg/MultiArrayDimension",
            label=self._labels,
            size=len(values),
            stride=len(values),
        )
        layout = self._make("std_msgs/msg/MultiArrayLayout", dim=[dimension], data_offset=0)
        return self._bytes("std_msgs/msg/Float64MultiArray", layout=layout, data=np.asarray(values))
