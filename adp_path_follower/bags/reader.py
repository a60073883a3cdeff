"""Read the bag of a run into arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.core.errors import FileError
from adp_path_follower.core.geometry import FloatArray, yaw_of_quaternion

_NODE = "path_follower"
# What a run is read from: the last part of a topic's name -> the key in `Run.series`.
_SERIES = (
    "odom",
    "ground_truth",
    "cmd_vel",
    f"{_NODE}/target",
    f"{_NODE}/tracking_error",
    f"{_NODE}/critic_weights",
    f"{_NODE}/actor_weights",
    f"{_NODE}/bellman_error",
    f"{_NODE}/excitation",
    f"{_NODE}/cost",
)


@dataclass(frozen=True)
class Series:
    """The messages of one topic as numbers.

    Attributes:
        stamp: Time of each message by its header, or by its arrival if it has none [ns], (N,).
        values: One row for each message; the columns depend on the type, shape (N, M).
        labels: Names of the columns of an array message.

    """

    stamp: np.ndarray
    values: FloatArray
    labels: tuple[str, ...] = ()


@dataclass(frozen=True)
class Run:
    """A recorded run.

    Attributes:
        series: Topic (without namespace) -> its messages. Poses are x, y, theta; odometry has
            v, w behind them; commands are v, w; errors s, y, theta.
        path_points: Positions of the last path, shape (N, 2); empty without one.
        configuration: What the controller said it runs with, as YAML; empty without one.
        message_counts: Topic -> number of messages, of every topic in the bag.

    """

    series: Mapping[str, Series]
    path_points: FloatArray
    configuration: str
    message_counts: Mapping[str, int]


def read_run(bag: Path) -> Run:
    """Return the run that a bag holds.

    Raises:
        FileError: The bag is missing or cannot be read.

    """
    if not bag.exists():
        raise FileError(f"bag {bag} does not exist")
    rows: dict[str, list[tuple[int, list[float]]]] = {}
    labels: dict[str, tuple[str, ...]] = {}
    path_points = np.zeros((0, 2))
    configuration = ""
    counts: dict[str, int] = {}
    try:
        with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            for connection, time, raw in reader.messages():
                counts[connection.topic] = counts.get(connection.topic, 0) + 1
                key = _key(connection.topic)
                if key is None:
                    continue
                message: Any = reader.deserialize(raw, connection.msgtype)
                if key == "path":
                    points = [[p.pose.position.x, p.pose.position.y] for p in message.poses]
                    path_points = np.array(points).reshape(-1, 2)
                elif key == "configuration":
                    configuration = message.data
                else:
                    rows.setdefault(key, []).append((_stamp(message, time), _numbers(message)))
                    if key not in labels and hasattr(message, "layout"):
                        labels[key] = tuple(message.layout.dim[0].label.split(", "))
    except (AnyReaderError, OSError, ValueError, KeyError, AssertionError) as error:
        raise FileError(f"bag {bag} cannot be read: {' '.join(str(error).split())}") from None
    series = {
        key: Series(
            np.array([stamp for stamp, _ in found], dtype=np.int64),
            np.array([values for _, values in found], dtype=float),
            labels.get(key, ()),
        )
        for key, found in rows.items()
    }
    return Run(series, path_points, configuration, counts)


def _key(topic: str) -> str | None:
    """Return the key of a topic in any namespace."""
    for name in (*_SERIES, "path", f"{_NODE}/configuration"):
        if topic == f"/{name}" or topic.endswith(f"/{name}"):
            return name.removeprefix(f"{_NODE}/")
    return None


def _stamp(message: Any, time: int) -> int:
    header = getattr(message, "header", None)
    if header is None:
        return time
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _numbers(message: Any) -> list[float]:
    """Return what a message says as a row of numbers."""
    kind = message.__msgtype__.rsplit("/", 1)[-1]
    if kind == "Odometry":
        twist = message.twist.twist
        return [*_planar(message.pose.pose), twist.linear.x, twist.angular.z]
    if kind == "PoseStamped":
        return _planar(message.pose)
    if kind == "Vector3Stamped":
        return [message.vector.x, message.vector.y, message.vector.z]
    if kind in ("Twist", "TwistStamped"):
        twist = message.twist if kind == "TwistStamped" else message
        return [twist.linear.x, twist.angular.z]
    return [float(value) for value in np.atleast_1d(message.data)]


def _planar(pose: Any) -> list[float]:
    """Return x, y and heading, as the controller takes them, to the last bit."""
    q = pose.orientation
    return [pose.position.x, pose.position.y, yaw_of_quaternion(q.x, q.y, q.z, q.w)]
