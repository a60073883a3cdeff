"""One MCAP file of a bag that is being written."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer

from adp_path_follower.bags.background_file import BackgroundFile

COMPRESSIONS = ("none", "zstd")
RECORD_OVERHEAD = 31  # [bytes] of a message record beside the message

_LIBRARY = "adp_path_follower"


@dataclass(frozen=True)
class TopicDefinition:
    """A topic as a bag describes it."""

    name: str  # the topic
    type_name: str  # its message type
    schema_encoding: str  # language of the type's definition, such as ros2msg
    schema: bytes  # the definition
    type_hash: str = ""  # hash of the type (RIHS01), empty if it is not known
    qos_profiles: Sequence[dict[str, Any]] = ()  # QoS profiles of its publishers
    message_encoding: str = "cdr"  # how messages are serialised
    metadata: Mapping[str, str] = field(default_factory=dict)  # further metadata of the channel


class BagFile:
    """A file with its own schemas, channels, index and statistics."""

    def __init__(self, path: FilePath, chunked: bool, zstd: bool, background: bool) -> None:
        """Create the file; raise OSError if it exists or cannot be written."""
        self.name = path.name
        self.message_count = 0
        self.first_time: int | None = None
        self.last_time = 0
        self._stream: BinaryIO | BackgroundFile = (
            BackgroundFile(path) if background else path.open("xb")
        )
        self._chunked = chunked or zstd
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._in_chunk = 0  # [bytes] in the chunk that was open when the file ended at `_end`
        self._is_finished = False
        self._mcap = Writer(
            self._stream,
            use_chunking=self._chunked,
            compression=CompressionType.ZSTD if zstd else CompressionType.NONE,
            enable_crcs=True,
        )
        self._mcap.start(profile="ros2", library=_LIBRARY)
        self._end = self._stream.tell()

    @property
    def size(self) -> int:
        """Return the length [bytes] up to now, with an open chunk as it is before packing."""
        end = self._stream.tell()
        if end != self._end:
            self._end, self._in_chunk = end, 0
        return end + self._in_chunk

    @property
    def is_settled(self) -> bool:
        """Return whether `close` would not have to wait for the disk."""
        return not isinstance(self._stream, BackgroundFile) or self._stream.is_settled

    def add_topic(self, topic: TopicDefinition) -> int:
        """Add a topic and return its number: 1 for the first one, and so on."""
        key = (topic.type_name, topic.schema_encoding, topic.schema)
        if key not in self._schemas:
            self._schemas[key] = self._mcap.register_schema(*key)
        number = self._mcap.register_channel(
            topic.name, topic.message_encoding, self._schemas[key], dict(topic.metadata)
        )
        return int(number)

    def write(
        self, topic: int, message: bytes, log_time: int, publish_time: int, sequence: int
    ) -> None:
        """Write a serialised message with its times [ns]."""
        first = self.first_time
        self.first_time = log_time if first is None else min(first, log_time)
        self.last_time = max(log_time, self.last_time)
        self.message_count += 1
        if self._chunked:
            self._in_chunk += len(message) + RECORD_OVERHEAD
        self._mcap.add_message(topic, log_time, message, publish_time, sequence)

    def flush(self) -> None:
        """Close the open chunk and hand everything to the operating system; may raise OSError."""
        self._mcap.flush()

    def check(self) -> None:
        """Raise OSError if something behind a finished file could not be written so far."""
        self._stream.flush()

    def finish(self) -> None:
        """Write index and statistics; `close` must follow."""
        if self._is_finished:
            return
        self._is_finished = True
        self._mcap.finish()
        if isinstance(self._stream, BackgroundFile):
            self._stream.end()

    def close(self) -> None:
        """Finish and close the file; raise OSError if not everything could be written."""
        try:
            self.finish()
        finally:
            self._stream.close()
