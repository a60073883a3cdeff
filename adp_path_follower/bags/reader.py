"""Open a bag, also where it was not closed, and read its run into arrays."""

import contextlib
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.bags.columns import Columns, Series
from adp_path_follower.bags.definitions import Reading, as_jazzy, kind_of
from adp_path_follower.bags.topics import Choice, chosen_topics
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.messages.raw import read_path
from adp_path_follower.messages.topics import SERIES

_FILES, _PACKED = (".mcap", ".db3"), (".zst", ".zstd")
_CONVERT = "convert one of ROS 1 with `rosbags-convert --src BAG --dst DIRECTORY`"
_OTHER_ENCODING = re.compile(r"serialization_format: *(?![\"']?cdr\b)\S+")
_METADATA = "metadata.yaml"
_REPORTED = 20_000  # messages between two reports of progress
_NEEDED = ("odom", "path")  # without which there is nothing to analyse or replay


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
            if _names_other_encodings(found):
                copy = stack.enter_context(tempfile.TemporaryDirectory(prefix="adp_bag_"))
                found = _said_to_be_cdr(found, FilePath(copy))
            reader = stack.enter_context(Reader(found))
            _take_topics_of_files(reader)
            yield reader, notes
    except FileError:
        raise
    except Exception as error:  # a damaged file fails in the reading library wherever it will
        reason = " ".join(str(error).split()) or type(error).__name__
        remedy = "`adp recover` may save what is in it"
        if "Profile is not" in reason:
            remedy = f"{_CONVERT}, one of another tool with `adp recover`"
        raise FileError(f"bag {bag} cannot be read: {reason.rstrip('.')}; {remedy}") from None


def messages_of(
    bag: FilePath, wanted: Callable[[str, str], bool]
) -> Iterator[tuple[int, str, bytes]]:
    """Yield arrival [ns], topic and content, as ROS 2 Jazzy writes it, of wanted (topic, type)s.

    Raises FileError if the bag, or the definition of a wanted type, cannot be read.
    """
    with opened_bag(bag) as (reader, _):
        chosen = [item for item in reader.connections if wanted(item.topic, kind_of(item))]
        readings = {connection.id: as_jazzy(connection) for connection in chosen}
        for connection, arrival, raw in reader.messages(chosen) if chosen else ():
            yield arrival, connection.topic, readings[connection.id](raw)


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
        remedy = _CONVERT if bag.suffix == ".bag" else "give a directory, or one .mcap or .db3 file"
        raise FileError(f"file {bag} is no bag of ROS 2: {remedy}")
    if not bag.is_dir() or (bag / _METADATA).exists():
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


def _metadata_of(bag: FilePath) -> str:
    return (bag / _METADATA).read_text(encoding="utf-8")


def _names_other_encodings(bag: FilePath) -> bool:
    """Return whether metadata.yaml names another encoding: the library refuses such bags whole."""
    return bag.is_dir() and _OTHER_ENCODING.search(_metadata_of(bag)) is not None


def _said_to_be_cdr(bag: FilePath, folder: FilePath) -> FilePath:
    """Return a bag of the same files, in a folder, whose metadata.yaml names one encoding only."""
    text = _OTHER_ENCODING.sub("serialization_format: cdr", _metadata_of(bag))
    for file in bag.iterdir():
        if file.name != _METADATA:
            (folder / file.name).symlink_to(file.resolve())
    (folder / _METADATA).write_text(text, encoding="utf-8")
    return folder


def _take_topics_of_files(reader: Reader) -> None:
    """Take a bag's topics and their encodings from its files: metadata.yaml may be older."""
    if isinstance(reader.storage, DirectoryReader):
        stored = [item for file in reader.storage.storages for item in file.connections]
        reader.storage.connections[:] = [
            item._replace(id=number) for number, item in enumerate(stored)
        ]


@dataclass(frozen=True)
class Diagnostic:
    """A status of one node in /diagnostics that differs from the one before."""

    time: int  # arrival [ns]
    name: str  # who said it
    level: int  # 0 is fine, 1 a warning, 2 an error, 3 stale
    message: str  # text of the status
    state: str  # state of the controller, empty from others


@dataclass(frozen=True)
class Run:
    """A recorded run."""

    # Topic (without namespace) -> its messages. Poses are x, y, theta; odometry has v, w behind
    # them; commands are v, w; errors s, y, theta.
    series: Mapping[str, Series]
    # Arrival [ns] and x, y, heading (NaN without), shape (N, 3), of each path that differs from the
    # one before.
    paths: tuple[tuple[int, FloatArray], ...]
    # Arrival [ns] and text (YAML) of what the controller said it runs with.
    configurations: tuple[tuple[int, str], ...]
    message_counts: Mapping[str, int]  # topic -> number of messages, of every topic in the bag
    diagnostics: tuple[Diagnostic, ...] = ()  # changes in /diagnostics
    # Key in `series` and "path" -> the topic that it was read from.
    topics: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # sentences about data that were left out
    # Content of the weights file that the controller started from, empty without one.
    initial_weights: bytes = b""
    path_frames: tuple[str, ...] = ()  # frame of each of `paths`; empty where it is not known
    span: tuple[int, int] = (0, 0)  # first and last arrival in the bag [ns]

    @property
    def configuration(self) -> str:
        """Return what the controller said last it runs with, as YAML; empty without it."""
        return self.configurations[-1][1] if self.configurations else ""

    @property
    def causes(self) -> str:
        """Return the notes as the end of a sentence about what is missing."""
        return "".join(f"; {note}" for note in self.notes)


def read_run(
    bag: FilePath,
    names: Mapping[str, str] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Run:
    """Return the run that a bag holds: a rosbag2 directory, or one .mcap or .db3 file.

    `names` maps "odom", "cmd_vel" or "path" to the topic to take for it; `progress` gets the
    fraction done. Raises FileError if the bag cannot be read, a topic is missing or has another
    type, it is not clear which one is meant, or no message of the odometry or of the path can be
    decoded.
    """
    with opened_bag(bag) as (reader, notes):
        choice = chosen_topics(bag, reader.connections, names or {})
        collector = _Collector(choice, reader, notes)
        for done, (connection, time, raw) in enumerate(reader.messages()):
            collector.take(connection, time, raw)
            if progress is not None and done % _REPORTED == 0:
                progress(min(1.0, done / max(1, reader.message_count)))
        return collector.run()


class _Collector:
    """Sorts messages by their topics."""

    def __init__(self, choice: Choice, reader: Reader, notes: list[str]) -> None:
        self._topics = choice.topics
        self._notes = [*notes, *choice.notes]
        self._first, self._last = 0, 0
        self._counts: dict[str, int] = {}
        self._paths: list[tuple[int, FloatArray]] = []
        self._frames: list[str] = []
        self._configurations: list[tuple[int, str]] = []
        self._diagnostics: list[Diagnostic] = []
        self._said: dict[str, tuple[int, str]] = {}
        self._last_path: bytes | None = None
        self._initial_weights = b""
        self._undecodable: dict[str, int] = {}  # key -> messages
        self._columns: dict[str, Columns] = {}
        # Connection -> what takes its messages, and what makes them those of ROS 2 Jazzy.
        self._handlers: dict[int, tuple[Callable[[int, bytes], None], Reading]] = {}
        keys = {topic: key for key, topic in self._topics.items()}
        for connection in reader.connections:
            key, kind = keys.get(connection.topic), kind_of(connection)
            if key is None or kind != choice.kinds[key]:
                continue
            try:
                convert = as_jazzy(connection)
            except FileError as error:
                if key in _NEEDED:
                    raise
                self._notes.append(f"{error}: passed over")
                continue
            self._handlers[connection.id] = self._handler(key, kind), convert

    def take(self, connection: Connection, time: int, raw: bytes) -> None:
        """Take one message that arrived at a time [ns]."""
        topic = connection.topic
        self._first = min(self._first, time) if self._counts else time
        self._last = max(self._last, time)
        self._counts[topic] = self._counts.get(topic, 0) + 1
        handler = self._handlers.get(connection.id)
        if handler is not None:
            take, convert = handler
            take(time, convert(raw))

    def run(self) -> Run:
        """Return what was collected; FileError if no odometry, or no path, can be decoded."""
        series = {}
        for key, columns in self._columns.items():
            found, self._undecodable[key], other_width = columns.series()
            if len(found.stamp):
                series[key] = found
            if other_width:
                self._note_left_out(key, other_width, "hold another number of values than most")
        for key, count in self._undecodable.items():
            if count:
                self._note_left_out(key, count, "cannot be decoded")
        return Run(
            series,
            tuple(self._paths),
            tuple(self._configurations),
            self._counts,
            tuple(self._diagnostics),
            self._topics,
            tuple(self._notes),
            self._initial_weights,
            tuple(self._frames),
            (self._first, self._last),
        )

    def _note_left_out(self, key: str, count: int, reason: str) -> None:
        topic = self._topics[key]
        total = self._counts[topic]
        if count == total and key in _NEEDED:
            raise FileError(f"topic {topic}: none of its {total} messages can be decoded")
        self._notes.append(f"topic {topic}: {count} of {total} messages {reason}: passed over")

    def _handler(self, key: str, kind: str) -> Callable[[int, bytes], None]:
        """Return what takes the messages of a topic."""
        if key in SERIES:
            return self._columns.setdefault(key, Columns(kind)).take
        take = {
            "path": self._take_path,
            "goal_path": self._take_path,
            "configuration": self._take_configuration,
            "initial_weights": self._take_initial_weights,
            "diagnostics": self._take_diagnostics,
        }[key]

        is_path, store = kind == "nav_msgs/msg/Path", get_typestore(Stores.ROS2_JAZZY)

        def handle(time: int, raw: bytes) -> None:
            if is_path and raw == self._last_path:  # published again, unchanged
                return
            try:
                message = read_path(raw) if is_path else store.deserialize_cdr(raw, kind)
            except Exception:  # whatever a damaged message does to the library
                self._undecodable[key] = self._undecodable.get(key, 0) + 1
                return
            self._last_path = raw if is_path else self._last_path
            take(time, message)

        return handle

    def _take_path(self, time: int, message: Any) -> None:
        poses = message.poses
        same = self._frames and message.frame == self._frames[-1]
        if not same or not np.array_equal(poses, self._paths[-1][1], equal_nan=True):
            self._paths.append((time, poses))
            self._frames.append(message.frame)

    def _take_configuration(self, time: int, message: Any) -> None:
        if not self._configurations or message.data != self._configurations[-1][1]:
            self._configurations.append((time, message.data))

    def _take_initial_weights(self, time: int, message: Any) -> None:
        self._initial_weights = bytes(message.data)

    def _take_diagnostics(self, time: int, message: Any) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            said = int(status.level), status.message
            if self._said.get(status.name) != said:
                self._said[status.name] = said
                self._diagnostics.append(
                    Diagnostic(time, status.name, *said, state=values.get("state", ""))
                )
