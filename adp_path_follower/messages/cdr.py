"""Read numbers out of serialised messages, thousands at once.

Messages of one topic differ in their numbers, and hardly ever in the lengths of their strings and
sequences. So where the numbers lie is found once, and then read from all messages of the same
lengths in one step.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from adp_path_follower.core.geometry import FloatArray

HEADER = 4  # bytes of encapsulation before the first field
STAMP = 8  # bytes
_NUMBER = 8  # bytes
_PADDING = 7  # [bytes], the most behind the last field


class CdrError(ValueError):
    """Report bytes that are not a message of the given definition."""


def byte_order(raw: bytes) -> str:
    """Return the byte order of a serialised message; CdrError if it is none."""
    if len(raw) < HEADER or raw[0] != 0 or raw[1] not in (0, 1):
        raise CdrError("no CDR encapsulation")
    return "<" if raw[1] else ">"


def aligned(at: int, size: int) -> int:
    """Return the next place at a multiple of a size [bytes]."""
    return at + -(at - HEADER) % size


def numbers_at(form: str, raw: bytes, at: int) -> tuple[Any, ...]:
    """Return numbers of a form of `struct` at a place; CdrError if the message is too short."""
    try:
        return struct.unpack_from(form, raw, at)
    except struct.error:
        raise too_short() from None


def text_at(raw: bytes, at: int, order: str) -> tuple[str, int]:
    """Return a string, and where it ends; CdrError if the message is too short."""
    (size,) = numbers_at(f"{order}I", raw, at)
    end = at + 4 + size
    if end > len(raw):
        raise too_short()
    return raw[at + 4 : end].rstrip(b"\0").decode(errors="replace"), end


def too_short() -> CdrError:
    """Return the error of a message that ends before its last field."""
    return CdrError("the message is shorter than its fields")


def check_end(message: bytes, end: int) -> None:
    """Raise CdrError where the last field of a message ends elsewhere than the message itself."""
    if end > len(message):
        raise too_short()
    if len(message) - end > _PADDING:  # by another definition its numbers are others
        raise CdrError("the message is longer than its fields")


@dataclass(frozen=True)
class NumbersKind:
    """A type of message that is numbers, 64 bits each, behind a header or a layout."""

    count: int | None  # how many there are; None for those of an array, which says it
    columns: tuple[int, ...] | None = None  # which of them are read; None for all
    texts: int = 0  # frames before the numbers, the first of them in a header


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
