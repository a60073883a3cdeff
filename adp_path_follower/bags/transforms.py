"""The transforms between frames that a bag holds in /tf and /tf_static."""

from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.bags.opening import opened_bag
from adp_path_follower.core.geometry import (
    FloatArray,
    pose_in_frame,
    tracking_error,
    yaw_of_quaternion,
)

_TOPICS = ("tf", "tf_static")  # in a namespace, too
_TYPE = "tf2_msgs/msg/TFMessage"
_DEEPEST = 50  # frames above another: a damaged bag may have them in a ring


@dataclass
class _Edge:
    """The place of a frame in the one above it: arrival [ns], stamp [ns], x, y, turn."""

    parent: str
    rows: list[tuple[int, int, float, float, float]] = field(default_factory=list)
    is_static: bool = False


class Transforms:
    """The tree of frames of a bag, in the plane."""

    def __init__(self) -> None:
        """Begin without any."""
        self._edges: dict[str, _Edge] = {}

    def take(self, arrival: int, message: Any, is_static: bool) -> None:
        """Take a message; a frame keeps the parent that it had first."""
        for item in message.transforms:
            place, turn = item.transform.translation, item.transform.rotation
            child, parent = frame_name(item.child_frame_id), frame_name(item.header.frame_id)
            edge = self._edges.setdefault(child, _Edge(parent, is_static=is_static))
            heading = yaw_of_quaternion(turn.x, turn.y, turn.z, turn.w)
            stamp = item.header.stamp.sec * 1_000_000_000 + item.header.stamp.nanosec
            if edge.parent == parent and np.isfinite([place.x, place.y, heading]).all():
                edge.rows.append((arrival, stamp, place.x, place.y, heading))

    def moved(
        self, poses: FloatArray, source: str, target: str, times: np.ndarray, by_arrival: bool
    ) -> tuple[FloatArray, float] | None:
        """Return poses (N, 3) in another frame, and for which share a transform was near in time.

        `times` [ns] (N,) are arrivals or stamps. Returns None where the bag has no way to the
        frame.
        """
        up, down = self._above(source), self._above(target)
        shared = next((frame for frame in up if frame in down), None)
        if shared is None:
            return None
        known = np.ones(len(poses), dtype=bool)
        for frame in up[: up.index(shared)]:
            place, near = self._place(frame, times, by_arrival)
            poses, known = pose_in_frame(poses, place), known & near
        for frame in reversed(down[: down.index(shared)]):
            place, near = self._place(frame, times, by_arrival)
            poses, known = tracking_error(poses, place), known & near
        return poses, float(known.mean()) if len(known) else 0.0

    def _above(self, frame: str) -> list[str]:
        """Return a frame and those above it, from the lowest to the root."""
        found = [frame]
        while found[-1] in self._edges and self._edges[found[-1]].rows and len(found) < _DEEPEST:
            found.append(self._edges[found[-1]].parent)
        return found

    def _place(
        self, frame: str, times: np.ndarray, by_arrival: bool
    ) -> tuple[FloatArray, np.ndarray]:
        """Return the place of a frame in its parent over time, (N, 3), and where it was known."""
        edge = self._edges[frame]
        rows = sorted(edge.rows, key=lambda row: row[0 if by_arrival else 1])
        at = np.array([row[0 if by_arrival else 1] for row in rows], dtype=np.int64)
        values = np.array([row[2:] for row in rows])
        if edge.is_static:
            latest = values[np.full(len(times), len(rows) - 1)]
            return latest, np.ones(len(times), dtype=bool)
        values[:, 2] = np.unwrap(values[:, 2])
        origin = at[0]
        since, own = (times - origin).astype(float), (at - origin).astype(float)
        place = np.stack([np.interp(since, own, column) for column in values.T], axis=-1)
        reach = 1e9 + 2.0 * float(np.median(np.diff(own))) if len(own) > 1 else 1e9
        return place, (since >= -reach) & (since <= own[-1] + reach)


def frame_name(name: str) -> str:
    """Return the name of a frame as tf2 has it: without a slash before it."""
    return name.removeprefix("/")


def read_transforms(bag: FilePath) -> Transforms:
    """Return the transforms of a bag, none without /tf; FileError if it cannot be read."""
    found, store = Transforms(), get_typestore(Stores.ROS2_JAZZY)
    with opened_bag(bag) as (reader, _):
        wanted = [
            connection
            for connection in reader.connections
            if connection.topic.rpartition("/")[2] in _TOPICS and connection.msgtype == _TYPE
        ]
        for connection, time, raw in reader.messages(wanted) if wanted else ():
            try:
                message = store.deserialize_cdr(raw, _TYPE)
            except Exception:  # noqa: S112  # whatever a damaged message does to the library
                continue
            found.take(time, message, connection.topic.endswith("tf_static"))
    return found
