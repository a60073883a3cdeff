"""Gather the messages of one topic as numbers, little by little, thousands decoded at once.

Messages of one topic differ in their numbers, and hardly ever in the lengths of their strings and
sequences. So where the numbers lie is found once, and then read from all messages of the same
lengths in one step.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.messages.raw import (
    HEADER,
    STAMP,
    CdrError,
    aligned,
    byte_order,
    check_end,
    numbers_at,
    text_at,
)

_BATCH = 4096  # messages that are decoded at once
_NUMBER = 8  # bytes


@dataclass(frozen=True)
class NumbersKind:
    """A type of message that is numbers, 64 bits each, behind a header or a layout."""

    count: int | None  # how many there are; None for those of an array, which says it
    columns: tuple[int, ...] | None = None  # which of them are read; None for all
    texts: int = 0  # frames before the numbers, the first of them in a header


_POSE = (0, 1, 3, 4, 5, 6)  # x, y and quaternion among the numbers of a pose
_TWIST = (0, 5)  # v and w among those of a twist
_BEHIND_POSE = 43  # numbers of a pose with its covariance
# Type -> its numbers, and which of them are read.
KINDS = {
    "nav_msgs/msg/Odometry": NumbersKind(
        85, (*_POSE, *(_BEHIND_POSE + place for place in _TWIST)), texts=2
    ),
    "geometry_msgs/msg/PoseStamped": NumbersKind(7, _POSE, texts=1),
    "geometry_msgs/msg/Vector3Stamped": NumbersKind(3, texts=1),
    "geometry_msgs/msg/TwistStamped": NumbersKind(6, _TWIST, texts=1),
    "geometry_msgs/msg/Twist": NumbersKind(6, _TWIST),
    "std_msgs/msg/Float64": NumbersKind(1),
    "std_msgs/msg/Float64MultiArray": NumbersKind(None),
}
_WITH_POSE = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped")


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

    def __init__(self, kind: str) -> None:
        """Take the type of the messages, one of `KINDS`."""
        self._has_pose, self._stamped = kind in _WITH_POSE, KINDS[kind].texts > 0
        self._is_array = KINDS[kind].count is None
        self._decoder = MessageDecoder(KINDS[kind])
        self._waiting: list[bytes] = []
        self._times: list[int] = []
        self._labels: tuple[str, ...] = ()
        self._frame = ""
        self._width: int | None = None  # values of a message, as most of the first ones have
        self._other_width = 0  # messages with another number of values
        # Stamps, arrivals and rows of messages, in order.
        self._pieces: list[tuple[np.ndarray, np.ndarray, FloatArray]] = []

    def take(self, time: int, raw: bytes) -> None:
        """Take one message that arrived at a time [ns]."""
        self._waiting.append(raw)
        self._times.append(time)
        if len(self._waiting) == _BATCH:
            self._decode()

    def series(self) -> tuple[Series, int, int]:
        """Return the messages, and how many are left out: undecodable, and of another width."""
        self._decode()
        nothing = np.zeros(0, dtype=np.int64)
        pieces = self._pieces or [(nothing, nothing, np.zeros((0, self._width or 0)))]
        self._pieces = []  # not twice in memory when the next topic is joined
        stamps, arrivals, values = map(np.concatenate, zip(*pieces, strict=True))
        found = Series(stamps, values, self._labels, arrivals, self._frame)
        return found, self._decoder.broken, self._other_width

    def _decode(self) -> None:
        if not self._waiting:
            return
        blocks = [
            (chosen, stamps, _planar(values) if self._has_pose else values)
            for chosen, stamps, values in self._decoder.decode(self._waiting)
        ]
        if blocks:
            if self._width is None:  # that of most: the first one's may be a damaged length
                widths: Counter[int] = Counter()
                for _, _, values in blocks:
                    widths[values.shape[1]] += len(values)
                self._width = widths.most_common(1)[0][0]
            first = min(int(chosen[0]) for chosen, _, _ in blocks)
            text = self._decoder.text(self._waiting[first])
            if self._stamped and not self._pieces:
                self._frame = text
            elif self._is_array and text and not self._labels:
                self._labels = tuple(text.split(", "))
            self._gather(blocks, self._width, np.array(self._times, dtype=np.int64))
        self._waiting, self._times = [], []

    def _gather(
        self, blocks: list[tuple[np.ndarray, np.ndarray, FloatArray]], width: int, times: np.ndarray
    ) -> None:
        """Keep decoded blocks in the order in which their messages arrived."""
        stamps, kept = times.copy(), np.zeros(len(times), dtype=bool)
        rows = np.full((len(times), width), np.nan)
        for chosen, block_stamps, values in blocks:
            if values.shape[1] != width:
                self._other_width += len(chosen)
                continue
            rows[chosen], kept[chosen] = values, True
            if self._stamped:
                stamps[chosen] = block_stamps
        self._pieces.append((stamps[kept], times[kept], rows[kept]))


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


class _Layout(NamedTuple):
    """Where the numbers of a message lie."""

    order: str
    lengths: tuple[int, ...]  # places of the lengths that decide about it
    start: int
    numbers: int  # how many there are
    text: str  # the frame of a header, or the label of an array


class MessageDecoder:
    """Reads the numbers of messages of one type."""

    def __init__(self, kind: NumbersKind) -> None:
        self._kind = kind
        self.broken = 0  # messages that were not of the type

    def decode(self, messages: Sequence[bytes]) -> list[tuple[np.ndarray, np.ndarray, FloatArray]]:
        """Return the numbers of messages, in blocks of equal layout.

        Each block has the places of its messages, shape (n,); their stamps [ns], shape (n,), zero
        without header; and a row of numbers for each, shape (n, M).
        """
        sizes = np.fromiter(map(len, messages), dtype=np.int64, count=len(messages))
        rest = np.arange(len(messages))
        blocks = []
        while len(rest):
            first = messages[rest[0]]
            try:
                layout = self._layout(first)
            except CdrError:
                self.broken += 1
                rest = rest[1:]
                continue
            alike = rest[sizes[rest] == len(first)]
            data = b"".join([messages[index] for index in alike])
            matrix = np.frombuffer(data, dtype=np.uint8).reshape(len(alike), len(first))
            fixed = [0, 1, *(at + byte for at in layout.lengths for byte in range(4))]
            same = (matrix[:, fixed] == matrix[0, fixed]).all(axis=1)
            if not same.all():
                matrix = np.ascontiguousarray(matrix[same])
            chosen = alike[same]
            blocks.append((chosen, *self._read(matrix, layout)))
            rest = rest[~np.isin(rest, chosen)]
        return blocks

    def text(self, message: bytes) -> str:
        """Return the frame in a sound message's header, or the label of an array's numbers."""
        return self._layout(message).text

    def _read(self, matrix: np.ndarray, layout: _Layout) -> tuple[np.ndarray, FloatArray]:
        """Return stamps and values of messages of one layout, one a row of bytes."""
        rows, size = matrix.shape

        def column(form: str, at: int) -> np.ndarray:
            return np.ndarray((rows,), layout.order + form, matrix, at, (size,))

        stamps = np.zeros(rows, dtype=np.int64)
        if self._kind.texts:
            stamps += column("i4", HEADER).astype(np.int64) * 1_000_000_000
            stamps += column("u4", HEADER + 4)
        shape, strides = (rows, layout.numbers), (size, _NUMBER)
        numbers = np.ndarray(shape, f"{layout.order}f8", matrix, layout.start, strides)
        columns = self._kind.columns
        chosen = numbers if columns is None else numbers[:, columns]
        return stamps, chosen.astype(float)

    def _layout(self, message: bytes) -> _Layout:
        """Return where the numbers of a message lie; CdrError if it is too short."""
        order = byte_order(message)
        lengths: list[int] = []
        found: list[str] = []

        def text(at: int) -> int:
            lengths.append(aligned(at, 4))
            content, end = text_at(message, lengths[-1], order)
            found.append(content)
            return end

        def length(at: int) -> int:
            lengths.append(at)
            (count,) = numbers_at(f"{order}I", message, at)
            return int(count)

        at, count = HEADER, self._kind.count
        if self._kind.texts:
            at += STAMP
        for _ in range(self._kind.texts):
            at = text(at)
        if count is None:
            dimensions, at = length(at), at + 4
            for _ in range(dimensions):
                at = aligned(text(at), 4) + 8  # behind size and stride
            count, at = length(aligned(at, 4) + 4), aligned(at, 4) + 8  # behind data_offset
        start = aligned(at, _NUMBER) if count else at
        check_end(message, start + _NUMBER * count)
        return _Layout(order, tuple(lengths), start, count, found[0] if found else "")
