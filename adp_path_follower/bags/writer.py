"""Write rosbag2 bags (MCAP) that survive the end of the writing process at any moment.

Everything up to the last `flush` can be read even if the process was killed: without compression
messages are not gathered in chunks, with it each flush closes the chunk. `close` adds index,
statistics and the final metadata.yaml.
"""

import contextlib
import functools
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import yaml

from adp_path_follower.bags.bag_file import RECORD_OVERHEAD, BagFile, TopicDefinition
from adp_path_follower.bags.installed_types import UnknownTypeError, type_text
from adp_path_follower.core.errors import FileError

__all__ = ["BagExistsError", "BagWriter", "Limits", "TopicDefinition", "UnknownTypeError"]

_MOST_TOPICS = 2**16 - 1
_RESERVE = "reserve.tmp"
_RESERVE_BYTES = 1024 * 1024  # for messages in memory, index and metadata.yaml on a full disk
NAME = "metadata.yaml"
_VERSION = 9


class BagExistsError(FileError):
    """Report that a bag cannot be made, as something of its name exists."""


@dataclass(frozen=True)
class Limits:
    """When a bag goes on in another file; 0 is never."""

    duration: int = 0  # time [ns] between the first and the last message of a file
    size: int = 0  # length [bytes] of a file without its index


class BagWriter:
    """A bag that is being written."""

    def __init__(
        self,
        directory: FilePath,
        custom_data: Mapping[str, str] | None = None,
        *,
        chunked: bool = False,
        compression: str = "none",
        limits: Limits | None = None,
        background: bool = False,
        information: Mapping[str, str] | None = None,
    ) -> None:
        """Create the bag's directory, which must not exist yet, and its first file.

        `custom_data` has entries of metadata.yaml beside the usual ones, `information` replaces
        these. `chunked` gathers messages, with an index and checksums, and loses those of the open
        chunk if the process is killed; "zstd" packs chunks. `limits` say when to go on in another
        file, by default never. `background` writes in a thread and keeps some disk space for the
        end, for bags that cannot be made again. Raises FileError if the directory exists, or cannot
        be made.
        """
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            raise BagExistsError(f"bag {directory} exists already: choose another name") from None
        except OSError as error:
            raise FileError(f"bag {directory} cannot be made: {error.strerror}") from None
        self.directory = directory
        self._custom_data = dict(custom_data or {})
        self._information = dict(information or {})
        self._new_file = functools.partial(
            BagFile, chunked=chunked, zstd=compression == "zstd", background=background
        )
        self._limits = limits or Limits()
        self._topics: dict[int, TopicDefinition] = {}
        self._counts: Counter[int] = Counter()  # messages of each topic
        self._files: list[BagFile] = []
        self._unsettled: list[BagFile] = []  # files that were split off and are still being written
        self._last_time = 0
        self._metadata_is_old = False
        try:
            if background:
                (directory / _RESERVE).write_bytes(bytes(_RESERVE_BYTES))
            self._start_file()
            self._write_metadata()
        except OSError as error:
            self._undo()
            raise FileError(f"bag {directory} cannot be written: {error.strerror}") from None

    @property
    def message_count(self) -> int:
        """Return the number of messages written."""
        return self._counts.total()

    @property
    def size(self) -> int:
        """Return the length [bytes] of all files."""
        return sum(file.size for file in self._files)

    def add_topic(
        self, name: str, type_name: str, qos_profiles: Sequence[dict[str, Any]] = ()
    ) -> int:
        """Add a topic, return its number; UnknownTypeError without type, FileError for too many."""
        text = type_text(type_name)
        profiles = [dict(profile) for profile in qos_profiles]
        number = self.copy_topic(
            TopicDefinition(
                name,
                type_name,
                "ros2msg",
                text.definition.encode(),
                text.type_hash,
                profiles,
                metadata={"offered_qos_profiles": yaml.safe_dump(profiles, sort_keys=False)},
            )
        )
        self._metadata_is_old = True
        return number

    def copy_topic(self, topic: TopicDefinition) -> int:
        """Add a topic defined elsewhere, in metadata.yaml after `close`; FileError for too many."""
        if len(self._topics) >= _MOST_TOPICS:
            raise FileError(f"bag {self.directory} cannot hold more than {_MOST_TOPICS} topics")
        number = self._files[-1].add_topic(topic)
        self._topics[number] = topic
        return number

    def write(self, topic: int, message: bytes, log_time: int, publish_time: int) -> None:
        """Write a serialised message with its times [ns]; log times never go back."""
        self.copy(topic, message, max(log_time, self._last_time), publish_time)

    def copy(
        self, topic: int, message: bytes, log_time: int, publish_time: int, sequence: int = 0
    ) -> None:
        """Write a serialised message with its times [ns] as they are; they may go back."""
        if self._is_full(log_time, len(message)):
            self._split()
        self._last_time = max(log_time, self._last_time)
        self._files[-1].write(topic, message, log_time, publish_time, sequence)
        self._counts[topic] += 1

    def flush(self) -> None:
        """Hand everything to the operating system; after an OSError, `close` must follow."""
        for file in tuple(self._unsettled):
            file.check()
            if file.is_settled:
                self._unsettled.remove(file)
                file.close()
        self._files[-1].flush()
        if self._metadata_is_old:
            self._write_metadata()

    def close(self) -> None:
        """Write index, statistics and metadata.yaml.

        Raises OSError if not everything could be written. The files then end with a whole record,
        for `recover`, and metadata.yaml is that of before.
        """
        (self.directory / _RESERVE).unlink(missing_ok=True)
        errors = []
        for file in (*self._unsettled, self._files[-1]):
            try:
                file.close()
            except OSError as error:
                errors.append(error)
        if errors:
            raise errors[0]
        self._write_metadata()

    def _is_full(self, log_time: int, length: int) -> bool:
        file, limits = self._files[-1], self._limits
        if file.first_time is None:
            return False
        if limits.duration and log_time - file.first_time >= limits.duration:
            return True
        return bool(limits.size) and file.size + length + RECORD_OVERHEAD > limits.size

    def _split(self) -> None:
        """Go on in another file, which defines all topics again."""
        full = self._files[-1]
        self._start_file()
        self._unsettled.append(full)
        full.finish()
        self._write_metadata()

    def _start_file(self) -> None:
        name = f"{self.directory.name}_{len(self._files)}.mcap"
        file = self._new_file(self.directory / name)
        for topic in self._topics.values():
            file.add_topic(topic)
        self._files.append(file)

    def _write_metadata(self) -> None:
        """Write a whole metadata.yaml in one step; after an OSError the one before is there."""
        content = yaml.dump(
            {"rosbag2_bagfile_information": {**self._content(), **self._information}},
            Dumper=_PlainDumper,
            sort_keys=False,
            allow_unicode=True,
        )
        temporary = self.directory / f"{NAME}.tmp"
        try:
            temporary.write_text(content, encoding="utf-8")
            temporary.replace(self.directory / NAME)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise
        self._metadata_is_old = False

    def _content(self) -> dict[str, Any]:
        """Return the usual content of metadata.yaml."""
        return {
            "version": _VERSION,
            "storage_identifier": "mcap",
            **_span(self._files),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.type_name,
                        "serialization_format": topic.message_encoding,
                        "offered_qos_profiles": list(topic.qos_profiles),
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": self._counts[number],
                }
                for number, topic in self._topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file.name for file in self._files],
            "files": [{"path": file.name, **_span([file])} for file in self._files],
            "custom_data": self._custom_data or None,
            "ros_distro": "jazzy",
        }

    def _undo(self) -> None:
        """Remove a bag that could not be begun."""
        for file in self._files:
            with contextlib.suppress(OSError):
                file.close()
        shutil.rmtree(self.directory, ignore_errors=True)


_FASTEST_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def _span(files: Sequence[BagFile]) -> dict[str, Any]:
    """Return times and number of the messages in some files."""
    first_times = [file.first_time for file in files if file.first_time is not None]
    start = min(first_times, default=0)
    return {
        "duration": {"nanoseconds": max(file.last_time for file in files) - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": sum(file.message_count for file in files),
    }


class _PlainDumper(_FASTEST_DUMPER):
    """YAML without anchors and aliases."""

    def ignore_aliases(self, data: object) -> bool:
        return True
