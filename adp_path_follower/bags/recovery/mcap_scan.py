"""Walk through the records of an MCAP file that may be cut or damaged anywhere.

The readers of the `mcap` package stop, raise or allocate what a damaged length says. This walk
takes a record only if its frame (opcode, length, what follows) makes sense, reads no body beyond
`MOST_BYTES`, and never holds more than one body.
"""

import io
import re
import struct
import zlib
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

from adp_path_follower.core.errors import FileError

MAGIC = b"\x89MCAP0\r\n"
LATEST_TIME = 2**63 - 1  # ROS keeps nanoseconds in a signed number
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time

_FRAME = struct.Struct("<BQ")
_FIRST_BLOCK, _BLOCK = 4096, 1024 * 1024  # of a search: most stretches are short
_CHAIN = 3  # frames in a row that make a place trustworthy again
_FIRST_PRIVATE = 0x80
_SHORTEST = {
    Opcode.HEADER: 8,
    Opcode.FOOTER: 20,
    Opcode.SCHEMA: 14,
    Opcode.CHANNEL: 16,
    Opcode.MESSAGE: MESSAGE_HEAD.size,
    Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6,
    Opcode.CHUNK_INDEX: 64,
    Opcode.ATTACHMENT: 36,
    Opcode.ATTACHMENT_INDEX: 48,
    Opcode.STATISTICS: 46,
    Opcode.METADATA: 8,
    Opcode.METADATA_INDEX: 20,
    Opcode.SUMMARY_OFFSET: 17,
    Opcode.DATA_END: 4,
}
_FIXED = (Opcode.FOOTER, Opcode.SUMMARY_OFFSET, Opcode.DATA_END)
_READ = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK)
# An opcode and a length below MOST_BYTES, or the magic between files.
_CANDIDATE = re.compile(rb"(?s)[\x01-\x0f](?=.{3}[\x00-\x08]\x00{4})|" + MAGIC)
MOST_BYTES = 128 * 1024 * 1024  # of a record that is read, and of a chunk when unpacked
CHUNK_HEAD = struct.Struct("<QQQII")  # first and last time, size, checksum, length of a name
_LONGEST_NAME = 8  # of a compression: lz4, zstd


@dataclass(frozen=True)
class Chunk:
    """The description of a chunk's content in its record."""

    size: int  # its size, unpacked
    checksum: int  # its CRC32, unpacked; 0 if there is none
    compression: str  # how it is packed
    data: memoryview  # the packed content, or the beginning of it
    torn: bool  # whether the end of the content is missing


def read_chunk(body: bytes, length: int) -> Chunk | None:
    """Return the chunk that begins a body of `length` bytes, None if the lengths in it disagree."""
    if len(body) < CHUNK_HEAD.size:
        return None
    _, _, size, checksum, name_length = CHUNK_HEAD.unpack_from(body)
    start = CHUNK_HEAD.size + name_length + 8
    if name_length > _LONGEST_NAME or len(body) < start:
        return None
    (data_length,) = struct.unpack_from("<Q", body, start - 8)
    name = body[CHUNK_HEAD.size : start - 8]
    if start + data_length != length or not name.isascii():
        return None
    data = memoryview(body)[start:]
    return Chunk(size, checksum, name.decode(), data, len(body) < length)


def unpack_chunk(chunk: Chunk) -> bytes | None:
    """Return the content of a chunk, or as much as there is of a torn one.

    Returns None if it is packed in an unknown way, longer than `MOST_BYTES`, or was changed. Raises
    FileError if the package that unpacks it is not installed.
    """
    if chunk.size > MOST_BYTES or chunk.compression not in ("", "lz4", "zstd"):
        return None
    content = _unpacked(chunk) if chunk.compression else bytes(chunk.data)
    if chunk.torn:
        return content if len(content) <= chunk.size else None
    sound = not chunk.checksum or zlib.crc32(content) == chunk.checksum
    return content if sound and len(content) == chunk.size else None


def _unpacked(chunk: Chunk) -> bytes:
    """Return what a compressed chunk unpacks to, at most a byte more than it says."""
    try:
        if chunk.compression == "lz4":
            from lz4.frame import LZ4FrameDecompressor

            return bytes(LZ4FrameDecompressor().decompress(chunk.data, chunk.size + 1))
        import zstandard

        reader = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(chunk.data))
        return bytes(reader.read(chunk.size + 1))
    except ImportError as error:
        raise FileError(
            f"the bag is packed with {chunk.compression}: install the Python package {error.name}"
        ) from None
    except Exception:  # lz4 and zstandard have no common error for data that is damaged
        return b""


class Record(NamedTuple):
    """A record."""

    offset: int  # where it begins
    opcode: int  # kind of the record
    length: int  # the length of its body, as it says
    body: bytes  # the body; empty where nobody needs it, and cut off at the end of a torn file


class RecordScanner:
    """The records of one file or chunk."""

    def __init__(
        self,
        stream: BinaryIO,
        size: int,
        channels: Container[int],
        is_whole: Callable[[bytes], bool],
    ) -> None:
        """Prepare a walk over the first `size` bytes of a stream, which must be seekable.

        `channels` are those that have been defined; `is_whole` says whether the body of a message
        record can be decoded to its last byte.
        """
        self.left = 0  # bytes that cannot be read, as far as the walk has come
        self._stream = stream
        self._size = size
        self._channels = channels
        self._is_whole = is_whole

    def records(self) -> Iterator[Record]:
        """Yield what can be trusted, in the order of the file.

        A record is trusted if its frame fits its kind and is followed by another frame or the
        end. Schemas, channels and chunks carry lengths inside, so that they are trusted if these
        agree. A message that is followed by something else is trusted if it decodes to its last
        byte; but not if it ends in zeros and zeros follow, as after a loss of power, because then
        nobody can tell where it was torn.

        After an unreadable stretch the walk goes on where a chain begins: two records in a row
        that are sound (a message of a known channel, a definition, a chunk), or a sound one and
        two other frames, or fewer if they end exactly with the file. So many fields do not agree
        by chance in the content of messages, so that resuming is safe; a single frame would not
        be. The one exception is an MCAP file inside a message that is damaged itself.
        """
        offset = 0
        while offset < self._size:
            if self._at(offset, len(MAGIC)) == MAGIC:
                offset += len(MAGIC)
                continue
            frame = self._frame(offset)
            record = self._read(offset, *frame) if frame else None
            if frame and record and self._is_trusted(record, frame[1]):
                yield record
                offset = min(frame[1], self._size)
            else:
                resumed = self._resume(offset + 1)
                self.left += resumed - offset
                offset = resumed

    def _at(self, offset: int, length: int) -> bytes:
        self._stream.seek(offset)
        return self._stream.read(max(0, min(length, self._size - offset)))

    def _frame(self, offset: int) -> tuple[int, int] | None:
        """Return opcode and end of a plausible record, which may lie behind the file's end."""
        head = self._at(offset, _FRAME.size)
        if len(head) < _FRAME.size:
            return None
        opcode, length = _FRAME.unpack(head)
        end = offset + _FRAME.size + length
        if opcode >= _FIRST_PRIVATE:
            return (opcode, end) if end <= self._size else None
        shortest = _SHORTEST.get(opcode)
        if shortest is None or length < shortest or (opcode in _FIXED and length > shortest):
            return None
        if length > MOST_BYTES and (opcode in _READ or end > self._size):
            return None
        return opcode, end

    def _read(self, offset: int, opcode: int, end: int) -> Record | None:
        """Return a record with its body, as far as it is needed."""
        if end > self._size and opcode != Opcode.CHUNK:
            return None
        start = offset + _FRAME.size
        body = self._at(start, end - start) if opcode in _READ else b""
        return Record(offset, opcode, end - start, body)

    def _is_trusted(self, record: Record, end: int) -> bool:
        if record.opcode == Opcode.CHUNK:
            return read_chunk(record.body, record.length) is not None
        if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            return read_definition(record.opcode, record.body) is not None
        if self._is_followed(end):
            return True
        if record.opcode != Opcode.MESSAGE:
            return False
        zeros_follow = not any(self._at(end, len(MAGIC)))
        return self._is_whole(record.body) and not (zeros_follow and record.body[-1] == 0)

    def _is_followed(self, offset: int) -> bool:
        """Return whether a frame, the magic or the end is here, or the beginning of one of them."""
        head = self._at(offset, _FRAME.size)
        if MAGIC.startswith(head[: len(MAGIC)]):
            return True
        if len(head) < _FRAME.size:
            return head[0] in _SHORTEST
        return self._frame(offset) is not None

    def _resume(self, start: int) -> int:
        """Return the first place from `start` on where a chain begins, or the end."""
        length = _FIRST_BLOCK
        while start < self._size:
            block = self._at(start, length)
            length = min(2 * length, _BLOCK)
            for found in _CANDIDATE.finditer(block):
                if self._begins_chain(start + found.start()):
                    return start + found.start()
            start += max(1, len(block) - _FRAME.size + 1)
        return self._size

    def _begins_chain(self, offset: int) -> bool:
        for count in range(_CHAIN):
            if offset == self._size or self._at(offset, len(MAGIC)) == MAGIC:
                return True
            if self._size - offset < _FRAME.size:
                return count >= _CHAIN - 1
            frame = self._frame(offset)
            if frame is None or frame[0] >= _FIRST_PRIVATE:
                return False
            opcode, end = frame
            if end > self._size:
                return count >= _CHAIN - 1
            sound = self._begins_soundly(offset + _FRAME.size, opcode, end)
            if count == 0 and not sound:
                return False
            if count == 1 and sound:
                return True
            offset = end
        return True

    def _begins_soundly(self, start: int, opcode: int, end: int) -> bool:
        """Return whether the body of a record that matters says what it should."""
        if opcode == Opcode.MESSAGE:
            channel, _, time, _ = MESSAGE_HEAD.unpack(self._at(start, MESSAGE_HEAD.size))
            return time <= LATEST_TIME and channel in self._channels
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            short = end - start <= _BLOCK
            return short and read_definition(opcode, self._at(start, end - start)) is not None
        if opcode == Opcode.CHUNK:
            return read_chunk(self._at(start, CHUNK_HEAD.size + 16), end - start) is not None
        return False


def read_definition(opcode: int, body: bytes) -> Schema | Channel | None:
    """Return a schema or channel, or None if the record does not hold exactly one."""
    if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
        return None
    kind = Schema if opcode == Opcode.SCHEMA else Channel
    try:
        found = kind.read(ReadDataStream(io.BytesIO(body)))
    except (McapError, struct.error, UnicodeDecodeError):
        return None
    builder = RecordBuilder()
    found.write(builder)
    # The package reads less than a length says without a word: writing it again shows it.
    return found if builder.end()[_FRAME.size :] == body else None
