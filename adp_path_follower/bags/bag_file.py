"""MCAP files of a bag that is being written; a thread can write them, so no slow disk delays."""

import contextlib
import os
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any, BinaryIO

from mcap.writer import CompressionType, Writer

_BATCH = 256 * 1024  # [bytes] that are handed to the thread without being asked
_MOST_WAITING = 64 * 1024 * 1024  # [bytes]; beyond it the disk sets the pace, as memory is bounded
_LIBRARY = "adp_path_follower"


class BackgroundFile:
    """A new file to append to.

    Each piece that is given to `write` is whole or missing in the file: where the disk is full, the
    file is cut behind the last piece that fits. The rest waits for another attempt by `close`.
    """

    def __init__(self, path: FilePath) -> None:
        """Create the file and start its thread; OSError if it exists or cannot be made."""
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
        self._descriptor = os.open(path, flags, 0o666)
        self._length = 0  # of all that was given
        self._written = 0
        self._batch: list[bytes] = []
        self._batch_bytes = 0
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._error: OSError | None = None
        self._closing = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=path.name, daemon=True)
        self._thread.start()

    @property
    def is_settled(self) -> bool:
        """Return whether the thread has ended: `close` does not wait for it."""
        return not self._thread.is_alive()

    def tell(self) -> int:
        """Return the length [bytes] of all that was given, written or not."""
        return self._length

    def write(self, piece: bytes) -> int:
        """Take a piece; it is lost if the process is killed before `flush`."""
        self._batch.append(piece)
        self._length += len(piece)
        self._batch_bytes += len(piece)
        if self._batch_bytes >= _BATCH:
            self._hand_over()
        return len(piece)

    def flush(self) -> None:
        """Have everything written at once, by the thread; OSError if an earlier piece failed."""
        self._hand_over()
        if self._error is not None:
            raise self._error

    def end(self) -> None:
        """Have the thread write everything and end."""
        self._hand_over()
        with self._changed:
            self._closing = True
            self._changed.notify_all()

    def close(self) -> None:
        """Write everything, with another attempt at what failed, and close; may raise OSError."""
        self.end()
        self._thread.join()
        try:
            self._write_waiting()
        finally:
            os.close(self._descriptor)

    def _hand_over(self) -> None:
        with self._changed:
            self._changed.wait_for(
                lambda: self._waiting_bytes < _MOST_WAITING or self._error is not None
            )
            self._waiting.extend(self._batch)
            self._waiting_bytes += self._batch_bytes
            self._changed.notify_all()
        self._batch = []
        self._batch_bytes = 0

    def _run(self) -> None:
        """Write what comes until the end, or until the first error."""
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._waiting or self._closing)
                    if not self._waiting:
                        return
                self._write_waiting()
        except OSError as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _write_waiting(self) -> None:
        """Write all pieces that wait, each whole, or as many as there is room for."""
        while self._waiting:
            piece = rest = memoryview(self._waiting[0])
            try:
                while rest:
                    rest = rest[os.write(self._descriptor, rest) :]
            except OSError:
                with contextlib.suppress(OSError):
                    os.ftruncate(self._descriptor, self._written)
                raise
            with self._changed:
                self._waiting.popleft()
                self._waiting_bytes -= len(piece)
                self._written += len(piece)
                self._changed.notify_all()


COMPRESSIONS = ("none", "zstd")
RECORD_OVERHEAD = 31  # [bytes] of a message record beside the message


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
        if key not in self._schemas:  # a type without a name is none
            self._schemas[key] = self._mcap.register_schema(*key) if topic.type_name else 0
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
