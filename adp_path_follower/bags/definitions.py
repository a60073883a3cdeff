"""Read messages by the definitions of their types in a bag, where ROS 2 Jazzy's are others."""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO

import numpy as np
from rosbags.interfaces import Connection, MessageDefinitionFormat, Nodetype
from rosbags.interfaces import MessageDefinition as RosbagsDefinition
from rosbags.rosbag2 import storage_mcap
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from adp_path_follower.core.errors import FileError

_SEPARATOR = "=" * 80  # between the texts of types
_MOST_BYTES = 1024 * 1024  # of a definition in a bag; ROS's longest have 50 kB
_ROS_ENCODINGS = ("ros2msg", "ros2idl", "omgidl")
_FOREIGN_ENCODINGS = ("ros1msg", "protobuf", "flatbuffer", "jsonschema")
# Nothing is computed from these: where a bag's definition lacks them, they are zero or empty.
_NOT_NEEDED = ("covariance", "frame_id", "child_frame_id", "hardware_id")
_TEXTS = ("string", "wstring")
_LANGUAGES = (*_ROS_ENCODINGS, "")  # of definitions that rosbags knows

Reading = Callable[[bytes], bytes]


def _definition_of(
    schema: storage_mcap.Schema | None, known: Callable[..., RosbagsDefinition]
) -> RosbagsDefinition:
    """Return the definition in a schema, of other languages than ROS 2's only their name."""
    if schema is not None and schema.encoding not in _LANGUAGES:
        return RosbagsDefinition(MessageDefinitionFormat.NONE, schema.encoding)
    return known(schema)


def _read_string(bio: BinaryIO) -> str:
    return storage_mcap.read_bytes(bio).decode(errors="replace")


# rosbags refuses a file for one topic in another encoding, of which nothing need be read; so it
# does again if a later release has these functions no more.
if hasattr(storage_mcap, "get_msgdef"):
    storage_mcap.get_msgdef = functools.partial(_definition_of, known=storage_mcap.get_msgdef)
    storage_mcap.read_string = _read_string


def kind_of(connection: Connection) -> str:
    """Return the type of a topic's messages, with their encoding if that is not ROS 2's."""
    definition, encoding = connection.msgdef, getattr(connection.ext, "serialization_format", "cdr")
    if encoding == "cdr" and definition.format == MessageDefinitionFormat.NONE:
        encoding = definition.data or encoding
    return connection.msgtype if encoding == "cdr" else f"{connection.msgtype} in {encoding}"


def as_jazzy(connection: Connection) -> Reading:
    """Return what makes messages of a connection those that ROS 2 Jazzy would have written.

    Fields go by their names; others than Jazzy's are passed over. Raises FileError if the bag's
    definition of the type lacks a field that is needed, has it of another type, or is damaged.
    """
    kind = connection.msgtype
    ours = get_typestore(Stores.ROS2_JAZZY)
    if connection.msgdef.format == MessageDefinitionFormat.NONE or kind not in ours.fielddefs:
        return bytes
    theirs = _store_of(connection.msgdef, kind)
    if theirs is not None and _same(theirs, ours, kind):
        return bytes
    damaged = f"{kind} by a text that is no definition"
    problem = damaged if theirs is None else next(_problems(theirs, ours, kind), "")
    if theirs is None or problem:
        remedy = "convert the bag" if theirs else "mend the bag with `adp recover`"
        raise FileError(
            f"topic {connection.topic} cannot be read: the bag defines {problem}; {remedy}, "
            "or record with the message packages of ROS 2 Jazzy"
        )

    def converted(raw: bytes) -> bytes:
        try:
            message = theirs.deserialize_cdr(raw, kind)
            return bytes(ours.serialize_cdr(_taken(ours, (Nodetype.NAME, kind), message), kind))
        except Exception:  # whatever a damaged message does to the library
            return b""

    return converted


@functools.lru_cache(maxsize=256)
def _store_of(definition: RosbagsDefinition, kind: str) -> Typestore | None:
    """Return the types of a definition, None for one that is not understood."""
    try:
        is_msg = definition.format == MessageDefinitionFormat.MSG
        store = _types_in(definition.data, kind, "ros2msg" if is_msg else "ros2idl")
        _complete(store, kind)
    except Exception:  # rosbags' parser has no common error
        return None
    return store


def _complete(store: Typestore, kind: str) -> None:
    """Add Jazzy's own types for those that a definition names, but does not give."""
    ours = get_typestore(Stores.ROS2_JAZZY)
    for inner in filter(None, map(_named, _fields(store, kind).values())):
        if inner not in store.fielddefs:
            store.register({inner: ours.fielddefs[inner]})
        _complete(store, inner)


def _types_in(text: str, name: str, encoding: str) -> Typestore:
    """Return the types in a definition, of .msg or of IDL files; rosbags' errors if it is wrong."""
    store = get_typestore(Stores.EMPTY)
    if encoding == "ros2msg":
        store.register(get_types_from_msg(text, name))
        return store
    for part in text.split(f"{_SEPARATOR}\n"):
        body = part.split("\n", 1)[1] if part.startswith("IDL: ") else part
        store.register(get_types_from_idl(body) if body.strip() else {})
    return store


def _fields(store: Typestore, kind: str) -> dict[str, Any]:
    return dict(store.fielddefs[kind][1])


def _same(theirs: Typestore, ours: Typestore, kind: str) -> bool:
    """Return whether both define a type, and all types in it, with the same fields."""
    fields = ours.fielddefs[kind][1]
    return theirs.fielddefs[kind][1] == fields and all(
        _same(theirs, ours, inner) for _, field in fields if (inner := _named(field))
    )


def _element(field: Any) -> Any:
    """Return the type of a field, or of what it is many of."""
    return field[1][0] if field[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else field


def _named(field: Any) -> str:
    """Return the name of the message type in a field, empty for numbers and texts."""
    node, content = _element(field)
    return str(content) if node == Nodetype.NAME else ""


def _shape(field: Any) -> str:
    """Return in words what a field is."""
    node, content = element = _element(field)
    kind = "text" if node == Nodetype.BASE and content[0] in _TEXTS else "number"
    kind = _named(element) or kind
    return kind if element is field else f"array of {kind}"


def _problems(theirs: Typestore, ours: Typestore, kind: str) -> Iterator[str]:
    """Yield how their type lacks what is needed of ours."""
    known = _fields(theirs, kind)
    for name, field in _fields(ours, kind).items():
        if name not in known:
            if name not in _NOT_NEEDED:
                yield f"{kind} without the field '{name}'"
        elif _shape(known[name]) != _shape(field):
            yield f"the field '{name}' of {kind} as {_shape(known[name])}, not as {_shape(field)}"
        elif inner := _named(field):
            yield from _problems(theirs, ours, inner)


def _taken(ours: Typestore, field: Any, value: Any) -> Any:
    """Return a value of the bag's type as one of ours; None stands for one that is missing."""
    node, content = field
    if node == Nodetype.NAME:
        parts = {
            name: _taken(ours, inner, getattr(value, name, None))
            for name, inner in _fields(ours, content).items()
        }
        return ours.types[content](**parts)
    if node == Nodetype.BASE:
        return value if value is not None else "" if content[0] in _TEXTS else 0
    element, length = content
    if element[0] == Nodetype.NAME or element[1][0] in _TEXTS:
        return [_taken(ours, element, item) for item in value or ()]
    return np.zeros(length) if value is None else np.asarray(value, dtype=element[1][0])


class MessageDefinition:
    """The definition of one message type in a bag."""

    def __init__(self, name: str, encoding: str, data: bytes) -> None:
        """Parse the definition of a type, as far as it is one of ROS."""
        self.name = name
        self.is_ros = encoding in _ROS_ENCODINGS
        self.is_text = _is_text(data)
        self.type_hash = ""
        self.types: Typestore | None = None  # this one and those in it, if it is understood
        # Nothing is known of other encodings, nor of a definition that the recorder did not find.
        self._is_foreign = encoding in _FOREIGN_ENCODINGS or not (encoding or data)
        if self.is_ros and len(data) <= _MOST_BYTES:
            with contextlib.suppress(Exception):  # rosbags' parser has no common error
                types = _types_in(data.decode(), name, encoding)
                self.type_hash = types.hash_rihs01(name)
                self.types = types

    @property
    def is_usable(self) -> bool:
        """Return whether readers can make something of it; others than ROS's are not looked at."""
        return self.types is not None or self._is_foreign

    def fits(self, message: bytes) -> bool:
        """Return whether a serialised message can be decoded to its last byte."""
        if self.types is None:
            return False
        try:
            decoded = self.types.deserialize_cdr(message, self.name)
            length = len(self.types.serialize_cdr(decoded, self.name))
        except Exception:  # as above
            return False
        return abs(length - len(message)) <= 3  # serialisers may pad to four bytes


def _is_text(data: bytes) -> bool:
    """Return whether a definition looks sound, as services' do, which rosbags cannot read."""
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return False
    return all(letter.isprintable() or letter in "\n\r\t" for letter in text)


# As parsing takes some milliseconds.
message_definition = functools.lru_cache(maxsize=256)(MessageDefinition)
