"""Judge the message definitions in a bag by what rosbags makes of them."""

import functools

from mcap.records import Schema
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from adp_path_follower.bags.definitions import types_of

_MOST_BYTES = 1024 * 1024  # of a definition; ROS's longest have 50 kB
_ROS_ENCODINGS = ("ros2msg", "ros2idl", "omgidl")
_FOREIGN_ENCODINGS = ("ros1msg", "protobuf", "flatbuffer", "jsonschema")


class MessageDefinition:
    """The definition of one message type."""

    def __init__(self, name: str, encoding: str, data: bytes) -> None:
        """Parse the definition of a type, as far as it is one of ROS."""
        self.name = name
        self.is_ros = encoding in _ROS_ENCODINGS
        self.is_text = _is_text(data)
        self.type_hash = ""
        self._store: Typestore | None = None
        # Nothing is known of other encodings, nor of a definition that the recorder did not find.
        self._is_foreign = encoding in _FOREIGN_ENCODINGS or not (encoding or data)
        if not self.is_ros or len(data) > _MOST_BYTES:
            return
        try:
            store = types_of(name, data.decode(), encoding == "ros2msg")
            self.type_hash = store.hash_rihs01(name)
            self._store = store
        except Exception:  # rosbags' parser has no common error
            self.type_hash = ""

    @property
    def is_usable(self) -> bool:
        """Return whether readers can make something of it; others than ROS's are not looked at."""
        return self._store is not None or self._is_foreign

    def fits(self, message: bytes) -> bool:
        """Return whether a serialised message can be decoded to its last byte."""
        if self._store is None:
            return False
        try:
            decoded = self._store.deserialize_cdr(message, self.name)
            length = len(self._store.serialize_cdr(decoded, self.name))
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


def jazzy_schema(schema: Schema) -> Schema | None:
    """Return ROS 2 Jazzy's own definition of a type, if it knows the type."""
    store = get_typestore(Stores.ROS2_JAZZY)
    if schema.name not in store.fielddefs:
        return None
    text, _ = store.generate_msgdef(schema.name, ros_version=2)
    return Schema(id=schema.id, name=schema.name, encoding="ros2msg", data=text.encode())
