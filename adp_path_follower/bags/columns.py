"""Gather the messages of one topic as numbers, little by little and without copies."""

import math
from dataclasses import dataclass, field

import numpy as np
from rosbags.typesys.store import Typestore

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.messages.cdr import MessageDecoder

_BATCH = 4096  # messages that are decoded at once
_TWIST = ("linear.x", "angular.z")
_POSE = ("position.x", "position.y", *(f"orientation.{axis}" for axis in "xyzw"))
# Type -> the fields whose numbers are read, and whether there is a header.
FIELDS: dict[str, tuple[tuple[str, ...], bool]] = {
    "nav_msgs/msg/Odometry": (
        (*(f"pose.pose.{name}" for name in _POSE), *(f"twist.twist.{name}" for name in _TWIST)),
        True,
    ),
    "geometry_msgs/msg/PoseStamped": (tuple(f"pose.{name}" for name in _POSE), True),
    "geometry_msgs/msg/Vector3Stamped": (("vector.x", "vector.y", "vector.z"), True),
    "geometry_msgs/msg/TwistStamped": (tuple(f"twist.{name}" for name in _TWIST), True),
    "geometry_msgs/msg/Twist": (_TWIST, False),
    "std_msgs/msg/Float64": (("data",), False),
    "std_msgs/msg/Float64MultiArray": (("data",), False),
}
_WITH_POSE = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped")
_ARRAY = "std_msgs/msg/Float64MultiArray"


@dataclass(frozen=True)
class Series:
    """The messages of one topic as numbers."""

    # Time of each message by its header, or by its arrival if it has none [ns], (N,).
    stamp: np.ndarray
    values: FloatArray  # one row for each message; the columns depend on the type, shape (N, M)
    labels: tuple[str, ...] = ()  # names of the columns of an array message
    # Time at which each message was recorded [ns], shape (N,).
    arrival: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    frame: str = ""  # of the first message, empty if it names none


class Columns:
    """The numbers of one topic, as they come in."""

    def __init__(self, store: Typestore, kind: str) -> None:
        """Take the typestore that defines the messages, and their type, one of `FIELDS`."""
        names, self._stamped = FIELDS[kind]
        self._has_pose, self._is_array = kind in _WITH_POSE, kind == _ARRAY
        self._decoder = MessageDecoder(store.fielddefs, kind, names, self._stamped)
        self._waiting: list[bytes] = []
        self._times: list[int] = []
        self._labels: tuple[str, ...] = ()
        self._frame = ""
        self._count = 0
        self._other_width = 0  # messages with another number of values than most of the first ones
        self._stamp = np.zeros(0, dtype=np.int64)
        self._arrival = np.zeros(0, dtype=np.int64)
        self._values: FloatArray | None = None

    def take(self, time: int, raw: bytes) -> None:
        """Take one message that arrived at a time [ns]."""
        self._waiting.append(raw)
        self._times.append(time)
        if len(self._waiting) == _BATCH:
            self._decode()

    def series(self) -> tuple[Series, int, int]:
        """Return the messages, and how many are left out: undecodable, and of another width."""
        self._decode()
        values = np.zeros((0, 0)) if self._values is None else self._values
        _resize(self._count, self._stamp, self._arrival, values)
        found = Series(self._stamp, values, self._labels, self._arrival, self._frame)
        return found, self._decoder.broken, self._other_width

    def _decode(self) -> None:
        if not self._waiting:
            return
        blocks = [
            (chosen, stamps, _planar(values) if self._has_pose else values)
            for chosen, stamps, values in self._decoder.decode(self._waiting)
        ]
        if blocks and self._stamped and not self._count:
            first = self._waiting[min(int(chosen[0]) for chosen, _, _ in blocks)]
            self._frame = self._decoder.text(first, "header.frame_id")
        if blocks and self._values is None:
            self._values = np.zeros((0, _usual_width([values for _, _, values in blocks])))
        if blocks and self._is_array and not self._labels:
            first = self._waiting[min(int(chosen[0]) for chosen, _, _ in blocks)]
            label = self._decoder.text(first, "layout.dim.0.label")
            self._labels = tuple(label.split(", ")) if label else ()
        self._gather(blocks, np.array(self._times, dtype=np.int64))
        self._waiting, self._times = [], []

    def _gather(
        self, blocks: list[tuple[np.ndarray, np.ndarray, FloatArray]], times: np.ndarray
    ) -> None:
        """Append decoded blocks in the order in which their messages arrived."""
        if self._values is None:
            return
        stamps, kept = times.copy(), np.zeros(len(times), dtype=bool)
        rows = np.full((len(times), self._values.shape[1]), np.nan)
        for chosen, block_stamps, values in blocks:
            if values.shape[1] != rows.shape[1]:
                self._other_width += len(chosen)
                continue
            rows[chosen], kept[chosen] = values, True
            if self._stamped:
                stamps[chosen] = block_stamps
        self._append(stamps[kept], times[kept], rows[kept] if not kept.all() else rows)

    def _append(self, stamps: np.ndarray, arrivals: np.ndarray, rows: FloatArray) -> None:
        assert self._values is not None
        end = self._count + len(rows)
        if end > len(self._stamp):
            # Resizing in place moves no memory, where joining pieces at the end would double it.
            room = max(end, math.ceil(1.2 * len(self._stamp)))
            _resize(room, self._stamp, self._arrival, self._values)
        self._stamp[self._count : end] = stamps
        self._arrival[self._count : end] = arrivals
        self._values[self._count : end] = rows
        self._count = end


def _usual_width(blocks: list[FloatArray]) -> int:
    """Return the number of columns that most rows have; the first one's may be a damaged length."""
    counts: dict[int, int] = {}
    for values in blocks:
        counts[values.shape[1]] = counts.get(values.shape[1], 0) + len(values)
    return max(counts, key=lambda width: counts[width])


def _resize(rows: int, *arrays: np.ndarray) -> None:
    for array in arrays:
        shape: tuple[int, ...] = array.shape
        array.resize((rows, *shape[1:]), refcheck=False)


def _planar(values: FloatArray) -> FloatArray:
    """Return poses (x, y, quaternion) as x, y, theta, with what follows them behind it."""
    x, y, z, w = values[:, 2:6].T
    # As `yaw_of_quaternion`, to the last bit: numpy's arctan2 need not round like math.atan2.
    with np.errstate(over="ignore", invalid="ignore"):  # a damaged message may hold anything
        sine, cosine = 2.0 * (w * z + x * y), w * w + x * x - y * y - z * z
    heading = np.fromiter(
        map(math.atan2, sine.tolist(), cosine.tolist()), dtype=float, count=len(values)
    )
    return np.column_stack([values[:, :2], heading, values[:, 6:]])
