"""Read the chunks of an MCAP file, whole or cut off, without trusting what they say."""

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

from adp_path_follower.core.errors import FileError

MOST_BYTES = 128 * 1024 * 1024  # of a record that is read, and of a chunk when unpacked
CHUNK_HEAD = struct.Struct("<QQQII")  # first and last time, size, checksum, length of a name

_LONGEST_NAME = 8  # of a compression: lz4, zstd
_PIECE = 256 * 1024


@dataclass(frozen=True)
class Chunk:
    """The description of a chunk's content in its record."""

    size: int  # its size, unpacked
    checksum: int  # its CRC32, unpacked; 0 if there is none
    compression: str  # how it is packed
    data: memoryview  # the packed content, or the beginning of it
    torn: bool  # whether the end of the content is missing


def read_chunk(body: bytes, length: int) -> Chunk | None:
    """Return a chunk, or None if the lengths in it disagree.

    Args:
        body: The record's body, or the beginning of it.
        length: The length that its frame declares.

    """
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

    Returns:
        None if it is packed in an unknown way, longer than `MOST_BYTES`, or not what it was:
        one cannot tell then which part of it has changed.

    Raises:
        FileError: The package that unpacks it is not installed.

    """
    if chunk.size > MOST_BYTES or chunk.compression not in ("", "lz4", "zstd"):
        return None
    content = _unpacked(chunk) if chunk.compression else bytes(chunk.data)
    if chunk.torn:
        return content if len(content) <= chunk.size else None
    sound = not chunk.checksum or zlib.crc32(content) == chunk.checksum
    return content if sound and len(content) == chunk.size else None


def _unpacked(chunk: Chunk) -> bytes:
    """Return what a compressed chunk unpacks to, up to one piece more than it says."""
    content = bytearray()
    try:
        for piece in _lz4(chunk) if chunk.compression == "lz4" else _zstd(chunk):
            content += piece
            if len(content) > chunk.size:
                break
    except ImportError as error:
        raise FileError(
            f"the bag is packed with {chunk.compression}: install the Python package {error.name}"
        ) from None
    except Exception:  # lz4 and zstandard have no common error for data that is damaged
        return bytes(content)
    return bytes(content)


def _lz4(chunk: Chunk) -> Iterator[bytes]:
    from lz4.frame import LZ4FrameDecompressor

    unpacker = LZ4FrameDecompressor()
    piece = unpacker.decompress(chunk.data, _PIECE)
    while piece:
        yield piece
        piece = b"" if unpacker.eof else unpacker.decompress(b"", _PIECE)


def _zstd(chunk: Chunk) -> Iterator[bytes]:
    import zstandard

    reader = zstandard.ZstdDecompressor().stream_reader(io.BytesIO(chunk.data))
    while piece := reader.read(_PIECE):
        yield piece
