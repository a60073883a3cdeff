"""Read numbers out of serialised messages, thousands at once.

Messages of one topic differ in their numbers, and hardly ever in the lengths of their strings and
sequences. So where a field lies is found once, by following the message definition that the bag
itself holds, and then read from all messages of the same lengths in one step.
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from adp_path_follower.core.geometry import FloatArray

_FORMATS = {  # type of a field -> numpy's name of it
    "bool": "?",
    **dict.fromkeys(("byte", "char", "octet", "uint8"), "u1"),
    "int8": "i1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
_HEADER = 4  # bytes of encapsulation before the first field


class CdrError(ValueError):
    """Report bytes that are not a message of the given definition."""


@dataclass(frozen=True)
class _Place:
    """Where a field lies: numbers have a format and a count, strings the format "S"."""

    offset: int
    form: str
    count: int = 1


@dataclass
class _Layout:
    """The places of all fields of a message, and of the lengths that decide about them."""

    order: str
    places: dict[str, _Place] = field(default_factory=dict)
    lengths: list[int] = field(default_factory=list)


class MessageDecoder:
    """Reads some fields of the messages of one type."""

    def __init__(
        self,
        definitions: Mapping[str, Any],
        type_name: str,
        names: Sequence[str],
        stamped: bool,
    ) -> None:
        """Take the fields to read, as in "pose.position.x"; the last one may be a sequence.

        `definitions` has type name -> constants and fields, as rosbags' typestores have them;
        `stamped` messages have a header, whose stamp is read.
        """
        self._definitions, self._type_name = definitions, type_name
        self._names, self._stamped = tuple(names), stamped
        self.broken = 0  # messages that were not of the definition

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
            except (CdrError, struct.error):
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

    def text(self, message: bytes, name: str) -> str:
        """Return a string field of a message, empty if it has none of that name."""
        try:
            place = self._layout(message).places.get(name)
        except (CdrError, struct.error):
            return ""
        if place is None or place.form != "S":
            return ""
        content = message[place.offset : place.offset + place.count]
        return content.rstrip(b"\0").decode(errors="replace")

    def _read(self, matrix: np.ndarray, layout: _Layout) -> tuple[np.ndarray, FloatArray]:
        """Return stamps and values of messages of one layout, one a row of bytes."""
        count, size = matrix.shape

        def column(name: str) -> np.ndarray:
            place = layout.places[name]
            form = np.dtype(layout.order + place.form)
            return np.ndarray(
                (count, place.count),
                form,
                matrix,
                place.offset,
                (size, form.itemsize),
            )

        stamps = np.zeros(count, dtype=np.int64)
        if self._stamped:
            stamps += column("header.stamp.sec")[:, 0].astype(np.int64) * 1_000_000_000
            stamps += column("header.stamp.nanosec")[:, 0]
        columns = [column(name) for name in self._names]
        return stamps, np.concatenate(columns, axis=1, dtype=np.float64)

    def _layout(self, message: bytes) -> _Layout:
        """Return the places of a message's fields; CdrError if it is too short or lacks one."""
        if len(message) < _HEADER or message[0] != 0 or message[1] not in (0, 1):
            raise CdrError("no CDR encapsulation")
        layout = _Layout("<" if message[1] else ">")
        _Walk(self._definitions, message, layout).message(self._type_name, "")
        for name in self._names:
            place = layout.places.get(name)
            if place is None or place.form == "S":
                raise CdrError(f"{self._type_name} has no numbers '{name}'")
        return layout


class _Walk:
    """A walk over the fields of one message."""

    def __init__(self, definitions: Mapping[str, Any], message: bytes, layout: _Layout) -> None:
        self._definitions, self._message, self._layout = definitions, message, layout
        self._at = _HEADER

    def message(self, type_name: str, prefix: str) -> None:
        if type_name not in self._definitions:
            raise CdrError(f"unknown type {type_name}")
        for name, description in self._definitions[type_name][1]:
            self._field(f"{prefix}{name}", description)

    def _field(self, name: str, description: Any) -> None:
        kind, detail = description
        if kind == Nodetype.BASE:
            self._base(name, detail[0], 1)
        elif kind == Nodetype.NAME:
            self.message(detail, f"{name}.")
        else:
            item, count = detail
            if kind == Nodetype.SEQUENCE:
                count = self._length()
            # A declared length beyond the message would let the loop below run for hours.
            if count > len(self._message):
                raise CdrError("a sequence is longer than its message")
            if item[0] == Nodetype.BASE and item[1][0] in _FORMATS:
                self._base(name, item[1][0], count)
            else:
                for number in range(count):
                    self._field(f"{name}.{number}", item)

    def _base(self, name: str, kind: str, count: int) -> None:
        """Walk over one number or string, or over numbers in a row."""
        if kind == "string":
            size = self._length()
            self._put(name, "S", 1, size)
        elif kind in _FORMATS:
            form = _FORMATS[kind]
            size = 1 if form == "?" else int(form[1])
            if count:
                self._align(size)
            self._put(name, form, size, count)
        else:
            raise CdrError(f"fields of type {kind} are not supported")

    def _put(self, name: str, form: str, size: int, count: int) -> None:
        self._layout.places[name] = _Place(self._at, form, count)
        self._at += size * count
        if self._at > len(self._message):
            raise CdrError("the message is shorter than its fields")

    def _length(self) -> int:
        self._align(4)
        (length,) = struct.unpack_from(f"{self._layout.order}I", self._message, self._at)
        self._layout.lengths.append(self._at)
        self._at += 4
        return int(length)

    def _align(self, size: int) -> None:
        self._at += -(self._at - _HEADER) % size
