"""The transforms between frames that a bag holds in /tf and /tf_static."""

import contextlib
from dataclasses import dataclass, field
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower.bags.reader import messages_of
from adp_path_follower.core.geometry import FloatArray, pose_in_frame, tracking_error
from adp_path_follower.messages.raw import CdrError, way_between
from adp_path_follower.messages.raw import read_transforms as raw_transforms

_TOPICS = ("tf", "tf_static")  # in a namespace, too
_TYPE = "tf2_msgs/msg/TFMessage"


@dataclass
class _Edge:
    """The place of a frame in the one above it: arrival [ns], stamp [ns], x, y, turn."""

    parent: str
    rows: list[tuple[int, int, float, float, float]] = field(default_factory=list)
    is_static: bool = False


class Transforms:
    """The tree of frames of a bag, in the plane."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._parents: dict[str, str] = {}  # of frames whose place is known

    def take(self, arrival: int, raw: bytes, is_static: bool) -> None:
        """Take a serialised message (CdrError if it is none); a frame keeps its first parent."""
        for item in raw_transforms(raw):
            child, parent = frame_name(item.child), frame_name(item.parent)
            edge = self._edges.setdefault(child, _Edge(parent, is_static=is_static))
            if edge.parent == parent and np.isfinite(item.pose).all():
                edge.rows.append((arrival, item.stamp, *item.pose))
                self._parents[child] = parent

    def moved(
        self, poses: FloatArray, source: str, target: str, times: np.ndarray, by_arrival: bool
    ) -> FloatArray | None:
        """Return poses (N, 3) in another frame, NaN where no transform was near in time.

        `times` [ns] (N,) are arrivals or stamps. Returns None where the bag has no way to the
        frame.
        """
        way = way_between(self._parents, source, target)
        if way is None:
            return None
        rising, falling, _ = way
        known = np.ones(len(poses), dtype=bool)
        for frame in rising:
            place, near = self._place(frame, times, by_arrival)
            poses, known = pose_in_frame(poses, place), known & near
        for frame in falling:
            place, near = self._place(frame, times, by_arrival)
            poses, known = tracking_error(poses, place), known & near
        return np.where(known[:, None], poses, np.nan)

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
    found = Transforms()

    def wanted(topic: str, kind: str) -> bool:
        return topic.rpartition("/")[2] in _TOPICS and kind == _TYPE

    for arrival, topic, content in messages_of(bag, wanted):
        with contextlib.suppress(CdrError):
            found.take(arrival, content, topic.endswith("tf_static"))
    return found
