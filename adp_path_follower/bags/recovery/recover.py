"""Make a new, whole bag of what can be read in a torn one."""

import io
import re
import shutil
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import BinaryIO

import yaml
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from adp_path_follower.bags.definitions import MessageDefinition, message_definition
from adp_path_follower.bags.installed_types import text_of_jazzy
from adp_path_follower.bags.recovery import mcap_scan
from adp_path_follower.bags.recovery.metadata import (
    TornMetadata,
    read_torn_metadata,
    sound_qos_profiles,
)
from adp_path_follower.bags.writer import BagWriter, TopicDefinition
from adp_path_follower.core.errors import FileError

_SQLITE_MAGIC = b"SQLite format 3\0"
_MOST_TAIL, _MOST_SUMMARY = 64 * 1024, 32 * 1024 * 1024  # where a summary is looked for
_PROGRESS_STEP = 1024 * 1024
_FOOTER = bytes([Opcode.FOOTER, 20]) + bytes(7)
_FOOTER_SIZE = 29
_NO_SCHEMA = Schema(id=0, name="", encoding="", data=b"")  # of channels in JSON, for one


@dataclass(frozen=True)
class Recovery:
    """The result of recovering a torn bag."""

    bag: FilePath  # the new bag
    message_counts: Mapping[str, int]  # topic -> number of messages saved
    bytes_read: int  # size of the torn bag's files
    bytes_left: int  # how much of it could not be used; in a compressed chunk, counted unpacked


def recover(
    bag: FilePath,
    output: FilePath | None = None,
    progress: Callable[[float], None] = lambda _: None,
) -> Recovery:
    """Copy all messages that can be read into a new bag, with their bytes, times and schemas.

    Unreadable stretches are found and passed as `RecordScanner.records` says. A chunk with a wrong
    checksum is left as a whole, as the wrong message is unknown; a chunk that is cut off gives its
    whole messages. Where there is no checksum (a file without chunks, a chunk that lost its
    beginning or its end), bits that changed within a message cannot be seen. Attachments are not
    copied. A record or unpacked chunk of more than 128 MiB is left, as memory is bounded.

    The bag, a directory or one .mcap file, is not changed; the new one is by default beside it,
    named NAME_recovered. Raises FileError if there is no such bag or nothing to recover, or if the
    new one exists or cannot be written.
    """
    try:
        files = _storage_files(bag)
        name = bag.stem if bag.is_file() else bag.resolve().name
        target = output or (bag.resolve().parent / f"{name}_recovered")
        metadata = read_torn_metadata((bag.parent if bag.is_file() else bag) / "metadata.yaml")
        sizes = [file.stat().st_size for file in files]
    except (OSError, ValueError) as error:
        if isinstance(error, FileError):
            raise
        reason = error.strerror if isinstance(error, OSError) else error
        raise FileError(f"bag {str(bag)!r} cannot be read: {reason}") from None
    writer = BagWriter(target, metadata.custom_data, chunked=True, information=metadata.kept)
    copy = _Copy(writer, metadata)
    try:
        done, total = 0, max(1, sum(sizes))
        for file, size in zip(files, sizes, strict=True):
            for offset in copy.add_file(file, size):
                progress((done + offset) / total)
            done += size
        if not copy.message_counts and not any(map(_has_magic, files)):
            raise FileError(f"bag {bag} holds nothing that could be recovered: is it an MCAP bag?")
        writer.close()
    except BaseException as error:
        shutil.rmtree(target, ignore_errors=True)  # we made it, and nobody can use half of it
        if isinstance(error, OSError) and not isinstance(error, FileError):
            raise FileError(f"bag {bag} not recovered to {target}: {error.strerror}") from None
        raise
    return Recovery(target, dict(copy.message_counts), sum(sizes), copy.bytes_left)


def _storage_files(bag: FilePath) -> list[FilePath]:
    if not bag.exists():
        raise FileError(f"bag {bag} does not exist")
    if bag.is_dir():
        files = [file for file in bag.iterdir() if file.is_file()]
        found = [file for file in files if file.suffix == ".mcap"]
        if not found and any(file.suffix == ".db3" for file in files):
            raise FileError(_sqlite_sentence(bag))
        if not found and any(file.suffix == ".zstd" for file in files):
            raise FileError(f"bag {bag} has compressed files: unpack them first with `zstd -d`")
        if not found:
            raise FileError(f"bag {bag} holds no .mcap file: give a bag's directory or its file")
        # rosbag2 numbers the files: bag_2.mcap comes before bag_10.mcap.
        found.sort(key=lambda file: [_number(part) for part in re.split(r"(\d+)", file.name)])
        if all(file.stat().st_size == 0 for file in found):
            raise FileError(f"bag {bag} is empty: nothing was written before the recording ended")
        return found
    if not bag.is_file():
        raise FileError(f"bag {bag} is neither a directory nor a file: give a bag")
    with bag.open("rb") as stream:
        head = stream.read(len(_SQLITE_MAGIC))
    if head == _SQLITE_MAGIC or bag.suffix == ".db3":
        raise FileError(_sqlite_sentence(bag))
    if not head:
        raise FileError(f"bag {bag} is empty: nothing was written before the recording ended")
    if bag.suffix != ".mcap" and not head.startswith(mcap_scan.MAGIC):
        raise FileError(f"file {bag} is no MCAP file: give a bag's directory or its .mcap file")
    return [bag]


def _sqlite_sentence(bag: FilePath) -> str:
    return f"bag {bag} is an sqlite3 bag (.db3), not MCAP: recover it with `sqlite3 FILE .recover`"


def _number(part: str) -> tuple[int, str]:
    return (int(part), "") if part.isdecimal() and part.isascii() else (-1, part)


def _has_magic(file: FilePath) -> bool:
    with file.open("rb") as stream:
        return stream.read(len(mcap_scan.MAGIC)) == mcap_scan.MAGIC


class _Copy:
    """The way of a torn bag's files into a new bag."""

    def __init__(self, writer: BagWriter, metadata: TornMetadata) -> None:
        self.message_counts: Counter[str] = Counter()  # of each topic, also of empty ones
        self.bytes_left = 0
        self._writer = writer
        self._metadata = metadata
        self._numbers: dict[tuple[str, str, str, str, bytes], int] = {}
        self._start_file()

    def _start_file(self) -> None:
        """Forget the numbers of schemas and channels, which hold within a file."""
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, tuple[int, str, Schema]] = {}
        self._certain: set[tuple[type, int]] = set()
        self._defined: set[int] = set()  # channels that the file has defined on the way
        self._has_chunks = False

    def _scanner(self, stream: BinaryIO, size: int) -> mcap_scan.RecordScanner:
        return mcap_scan.RecordScanner(stream, size, self._channels, self._is_whole)

    def _is_whole(self, message: bytes) -> bool:
        """Return whether the body of a message record can be decoded to its last byte."""
        channel, _, _, _ = mcap_scan.MESSAGE_HEAD.unpack_from(message)
        if channel not in self._channels:
            return False
        return _meaning(self._channels[channel][2]).fits(message[mcap_scan.MESSAGE_HEAD.size :])

    def add_file(self, file: FilePath, size: int) -> Iterator[int]:
        """Copy a file; yield how far it is, from time to time."""
        self._start_file()
        with file.open("rb") as stream:
            # The definitions at its end, in case the first ones are damaged.
            for record in self._scanner(*_summary(stream, size)).records():
                definition = mcap_scan.read_definition(record.opcode, record.body)
                if definition is not None:
                    self._define(definition)
                    self._certain.add((type(definition), definition.id))
            shown, scanner = 0, self._scanner(stream, size)
            for record in scanner.records():
                if record.opcode == Opcode.CHUNK:
                    self._add_chunk(record)
                elif record.opcode == Opcode.MESSAGE and not self._belongs(record.body):
                    self.bytes_left += len(record.body)
                else:
                    self._add(record)
                if record.offset >= shown:
                    yield record.offset
                    shown = record.offset + _PROGRESS_STEP
            self.bytes_left += scanner.left

    def _belongs(self, message: bytes) -> bool:
        """Return whether the body of a message record outside chunks is a message.

        One bit makes other records look like one: in a file with chunks the index of a chunk, and
        before the channels the header and the definition of a channel. These do not decode.
        """
        (channel,) = struct.unpack_from("<H", message)
        expected = channel in self._defined and not self._has_chunks
        return expected or self._is_whole(message)

    def _add_chunk(self, record: mcap_scan.Record) -> None:
        self._has_chunks = True
        chunk = mcap_scan.read_chunk(record.body, record.length)
        content = mcap_scan.unpack_chunk(chunk) if chunk is not None else None
        if content is None:
            self.bytes_left += len(record.body)
            return
        scanner = self._scanner(io.BytesIO(content), len(content))
        for inner in scanner.records():
            if inner.opcode == Opcode.CHUNK:
                self.bytes_left += len(inner.body)  # chunks hold no chunks
            else:
                self._add(inner)
        self.bytes_left += scanner.left

    def _add(self, record: mcap_scan.Record) -> None:
        if record.opcode == Opcode.MESSAGE:
            self._add_message(record)
            return
        definition = mcap_scan.read_definition(record.opcode, record.body)
        if isinstance(definition, Channel):
            self._defined.add(definition.id)
        if definition is not None and (type(definition), definition.id) not in self._certain:
            self._define(definition)

    def _add_message(self, record: mcap_scan.Record) -> None:
        channel, sequence, log_time, publish_time = mcap_scan.MESSAGE_HEAD.unpack_from(record.body)
        if channel not in self._channels or log_time > mcap_scan.LATEST_TIME:
            self.bytes_left += len(record.body)
            return
        number, topic, _ = self._channels[channel]
        message = record.body[mcap_scan.MESSAGE_HEAD.size :]
        self._writer.copy(number, message, log_time, publish_time, sequence)
        self.message_counts[topic] += 1

    def _define(self, definition: Schema | Channel) -> None:
        """Take note of a schema, or add a channel to the new bag."""
        if isinstance(definition, Schema):
            self._schemas[definition.id] = definition
            return
        self._channels.pop(definition.id, None)
        schema = self._schemas.get(definition.schema_id) if definition.schema_id else _NO_SCHEMA
        if schema is None:
            return
        if not _meaning(schema).is_usable:
            # One type that is damaged makes a bag unreadable for rosbags, with all topics.
            known = text_of_jazzy(schema.name)
            if known is not None:
                schema = Schema(schema.id, known.definition.encode(), "ros2msg", schema.name)
            elif not _meaning(schema).is_text:
                return
        if _meaning(schema).is_ros:
            definition.message_encoding = "cdr"  # ROS 2 knows no other: what differs is damaged
        kind = (schema.name, schema.encoding, schema.data)
        key = (definition.topic, definition.message_encoding, *kind)
        if key not in self._numbers:
            self._numbers[key] = self._add_topic(definition, schema)
            self.message_counts[definition.topic] += 0
        self._channels[definition.id] = (self._numbers[key], definition.topic, schema)

    def _add_topic(self, channel: Channel, schema: Schema) -> int:
        """Add a topic with the QoS profiles that the channel states, or metadata.yaml."""
        stated = dict(channel.metadata)
        profiles = sound_qos_profiles(stated.get("offered_qos_profiles"))
        if profiles is None:
            profiles = self._metadata.qos_profiles.get(channel.topic, [])
            # Readers compare both places, and pass over a topic if they differ.
            stated["offered_qos_profiles"] = yaml.safe_dump(profiles, sort_keys=False)
        known_hash = self._metadata.type_hashes.get(channel.topic, "")
        return self._writer.copy_topic(
            TopicDefinition(
                channel.topic,
                schema.name,
                schema.encoding,
                schema.data,
                _meaning(schema).type_hash or stated.get("topic_type_hash", known_hash),
                profiles,
                channel.message_encoding,
                stated,
            )
        )


def _meaning(schema: Schema) -> MessageDefinition:
    return message_definition(schema.name, schema.encoding, schema.data)


def _summary(stream: BinaryIO, size: int) -> tuple[BinaryIO, int]:
    """Return the summary at the end of a file, and its length; empty if it is not sound."""
    start = max(0, size - _MOST_TAIL)
    stream.seek(start)
    tail = stream.read(size - start)
    footer = tail.rfind(_FOOTER)
    if footer < 0 or not tail.startswith(mcap_scan.MAGIC, footer + _FOOTER_SIZE):
        return io.BytesIO(), 0
    begin, _, checksum = struct.unpack_from("<QQI", tail, footer + len(_FOOTER))
    length = start + footer - begin
    if not begin or not 0 < length <= _MOST_SUMMARY:
        return io.BytesIO(), 0
    stream.seek(begin)
    summary = stream.read(length)
    if checksum and zlib.crc32(tail[footer : footer + 25], zlib.crc32(summary)) != checksum:
        return io.BytesIO(), 0
    return io.BytesIO(summary), length
