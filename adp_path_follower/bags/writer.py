"""Write rosbag2 bags (MCAP) that survive the end of the writing process at any moment.

Messages are not gathered in chunks, so everything up to the last `flush` can be read even if the
process was killed; `close` adds index, statistics and the final metadata.yaml. A bag that is made
from another one has chunks instead: it can be made again, and chunks bring an index of messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.core.errors import FileError

_METADATA_VERSION = 9  # rosbag2 of ROS 2 Jazzy
_LIBRARY = "adp_path_follower"
_MOST_TOPICS = 2**16 - 1


class UnknownTypeError(FileError):
    """Report a message type whose definition is not known."""


@dataclass(frozen=True)
class TopicDefinition:
    """A topic as a bag describes it.

    Attributes:
        name: The topic.
        type_name: Its message type.
        schema_encoding: What the definition of the type is written in, as ros2msg.
        schema: The definition.
        type_hash: Hash of the type (RIHS01), empty if it is not known.
        qos_profiles: QoS profiles of its publishers.
        message_encoding: How messages are serialised.
        metadata: What the channel says beside.

    """

    name: str
    type_name: str
    schema_encoding: str
    schema: bytes
    type_hash: str = ""
    qos_profiles: Sequence[dict[str, Any]] = ()
    message_encoding: str = "cdr"
    metadata: Mapping[str, str] = field(default_factory=dict)


@dataclass
class _Topic:
    definition: TopicDefinition
    message_count: int = 0


class BagWriter:
    """A bag that is being written."""

    def __init__(
        self,
        directory: Path,
        custom_data: Mapping[str, str] | None = None,
        *,
        chunked: bool = False,
        information: Mapping[str, str] | None = None,
    ) -> None:
        """Create the bag's directory and file.

        Args:
            directory: The bag: a directory that must not exist yet.
            custom_data: What metadata.yaml shall say beside the usual.
            chunked: Gather messages in chunks, with an index and checksums; they are lost if the
                process is killed.
            information: Entries of metadata.yaml that replace the usual ones.

        Raises:
            FileError: The directory exists, or cannot be made.

        """
        try:
            directory.mkdir(parents=True)
            self._file = (directory / f"{directory.name}_0.mcap").open("xb")
        except FileExistsError:
            raise FileError(f"bag {directory} exists already: choose another name") from None
        except OSError as error:
            raise FileError(f"bag {directory} cannot be made: {error.strerror}") from None
        self.directory = directory
        self._custom_data = dict(custom_data or {})
        self._information = dict(information or {})
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._topics: dict[int, _Topic] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._first_time: int | None = None
        self._last_time = 0
        self._mcap = Writer(
            self._file, use_chunking=chunked, compression=CompressionType.NONE, enable_crcs=True
        )
        self._mcap.start(profile="ros2", library=_LIBRARY)
        self._write_metadata()

    @property
    def message_count(self) -> int:
        """Return the number of messages written."""
        return sum(topic.message_count for topic in self._topics.values())

    def add_topic(
        self, name: str, type_name: str, qos_profiles: Sequence[dict[str, Any]] = ()
    ) -> int:
        """Add a topic and return the number to write its messages with.

        Raises:
            UnknownTypeError: The definition of the message type is not known.

        """
        if type_name not in self._typestore.fielddefs:
            raise UnknownTypeError(f"topic {name} has the unknown type {type_name}: not recorded")
        definition, _ = self._typestore.generate_msgdef(type_name, ros_version=2)
        profiles = [dict(profile) for profile in qos_profiles]
        number = self.copy_topic(
            TopicDefinition(
                name,
                type_name,
                "ros2msg",
                definition.encode(),
                self._typestore.hash_rihs01(type_name),
                profiles,
                metadata={"offered_qos_profiles": yaml.safe_dump(profiles, sort_keys=False)},
            )
        )
        self._write_metadata()
        return number

    def copy_topic(self, topic: TopicDefinition) -> int:
        """Add a topic as it is defined elsewhere; metadata.yaml shows it after `close`.

        Raises:
            FileError: There are more topics than the format can number.

        """
        if len(self._topics) >= _MOST_TOPICS:
            raise FileError(f"bag {self.directory} cannot hold more than {_MOST_TOPICS} topics")
        key = (topic.type_name, topic.schema_encoding, topic.schema)
        if key not in self._schemas:
            self._schemas[key] = self._mcap.register_schema(*key)
        channel = self._mcap.register_channel(
            topic.name, topic.message_encoding, self._schemas[key], dict(topic.metadata)
        )
        self._topics[channel] = _Topic(topic)
        return int(channel)

    def write(self, topic: int, message: bytes, log_time: int, publish_time: int) -> None:
        """Write a serialised message with its times [ns]; log times never go back."""
        self.copy(topic, message, max(log_time, self._last_time), publish_time)

    def copy(
        self, topic: int, message: bytes, log_time: int, publish_time: int, sequence: int = 0
    ) -> None:
        """Write a serialised message with its times [ns] as they are; they may go back."""
        first = self._first_time
        self._first_time = log_time if first is None else min(first, log_time)
        self._last_time = max(log_time, self._last_time)
        self._mcap.add_message(topic, log_time, message, publish_time, sequence)
        self._topics[topic].message_count += 1

    def flush(self) -> None:
        """Hand everything to the operating system: it then outlives this process."""
        self._file.flush()

    def close(self) -> None:
        """Write index, statistics and metadata.yaml."""
        self._mcap.finish()
        self._file.close()
        self._write_metadata()

    def _write_metadata(self) -> None:
        """Write metadata.yaml as of now; exchanged in one step, so that it is always whole."""
        start = self._first_time or 0
        span: dict[str, Any] = {
            "duration": {"nanoseconds": self._last_time - start},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": self.message_count,
        }
        name = f"{self.directory.name}_0.mcap"
        information = {
            "version": _METADATA_VERSION,
            "storage_identifier": "mcap",
            **span,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.definition.name,
                        "type": topic.definition.type_name,
                        "serialization_format": topic.definition.message_encoding,
                        "offered_qos_profiles": list(topic.definition.qos_profiles),
                        "type_description_hash": topic.definition.type_hash,
                    },
                    "message_count": topic.message_count,
                }
                for topic in self._topics.values()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [name],
            "files": [{"path": name, **span}],
            "custom_data": self._custom_data or None,
            "ros_distro": "jazzy",
            **self._information,
        }
        content = yaml.dump(
            {"rosbag2_bagfile_information": information}, Dumper=_PlainDumper, sort_keys=False
        )
        temporary = self.directory / "metadata.yaml.tmp"
        temporary.write_text(content, encoding="utf-8")
        temporary.replace(self.directory / "metadata.yaml")


class _PlainDumper(yaml.SafeDumper):
    """YAML without anchors and aliases."""

    def ignore_aliases(self, data: object) -> bool:
        """Return True: write everything out."""
        return True
