"""The bag that a name means, made readable where it was not closed."""

import contextlib
import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path as FilePath

from rosbags.rosbag2 import Reader

from adp_path_follower.core.errors import FileError

_FILES, _PACKED = (".mcap", ".db3"), (".zst", ".zstd")


@contextlib.contextmanager
def opened_bag(bag: FilePath) -> Iterator[tuple[Reader, list[str]]]:
    """Yield a reader of a bag, a file of one, or a directory with one, and notes; or FileError."""
    found = _bag_in(bag)
    notes = [] if found == bag else [f"the bag in {bag} is {found.name}: it was read"]
    try:
        with contextlib.ExitStack() as stack:
            if _logs(found):
                copy = stack.enter_context(tempfile.TemporaryDirectory(prefix="adp_bag_"))
                found = _merged(found, FilePath(copy))
                notes.append(
                    "the recording of this sqlite3 bag was not ended: messages of its -wal file "
                    "were read, too"
                )
            yield stack.enter_context(Reader(found)), notes
    except FileError:
        raise
    except Exception as error:  # a damaged file fails in the reading library wherever it will
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(
            f"bag {bag} cannot be read: {reason.rstrip('.')}; `adp recover` may save what is in it"
        ) from None


def _bag_in(bag: FilePath) -> FilePath:
    """Return the bag that is meant; FileError, before the library's, if it is none."""
    if not bag.exists():
        raise FileError(f"bag {bag} does not exist")
    if bag.suffix in _PACKED and bag.is_file():
        raise FileError(
            f"file {bag} is packed: give the directory of its bag, or unpack it with: unzstd "
            f"{bag.name}"
        )
    if bag.is_file() and bag.suffix not in _FILES:
        raise FileError(f"file {bag} is no bag: give a directory, or one .mcap or .db3 file")
    if not bag.is_dir() or (bag / "metadata.yaml").exists():
        return bag
    if any(set(file.suffixes) & set(_FILES) for file in bag.iterdir()):
        raise FileError(
            f"bag {bag} has no metadata.yaml: `adp recover` makes a bag of MCAP files, `ros2 bag "
            "reindex` of others; or give one of its files"
        )
    inside = sorted(file.parent for file in bag.glob("*/metadata.yaml"))
    if len(inside) > 1:
        names = ", ".join(item.name for item in inside)
        raise FileError(f"directory {bag} holds several bags: give one of {names}")
    if not inside:
        raise FileError(f"directory {bag} holds no bag: neither metadata.yaml nor .mcap or .db3")
    return inside[0]


def _logs(bag: FilePath) -> list[FilePath]:
    """Return the write-ahead logs of a sqlite3 bag that hold messages."""
    files = bag.glob("*.db3-wal") if bag.is_dir() else [bag.with_name(f"{bag.name}-wal")]
    return [file for file in files if file.is_file() and file.stat().st_size]


def _merged(bag: FilePath, folder: FilePath) -> FilePath:
    """Return a copy of a bag with what its write-ahead logs hold; the bag itself stays as it is."""
    copy = folder / bag.name
    if bag.is_dir():
        shutil.copytree(bag, copy)
    else:
        for file in (bag, bag.with_name(f"{bag.name}-wal")):
            shutil.copy(file, folder / file.name)
    for log in _logs(copy):
        with contextlib.closing(sqlite3.connect(log.with_name(log.name[: -len("-wal")]))) as base:
            base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    return copy
