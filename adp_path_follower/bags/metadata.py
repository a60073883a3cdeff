"""The metadata.yaml of a bag, as rosbag2 of ROS 2 Jazzy writes it."""

from collections.abc import Mapping, Sequence
from pathlib import Path as FilePath
from typing import Any

import yaml

from adp_path_follower.bags.bag_file import BagFile, TopicDefinition

NAME = "metadata.yaml"

_VERSION = 9
_FASTEST_DUMPER: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def bag_information(
    files: Sequence[BagFile],
    topics: Sequence[tuple[TopicDefinition, int]],
    custom_data: Mapping[str, str],
) -> dict[str, Any]:
    """Return the content of a bag's metadata.yaml.

    The files are in the order they were written, the topics come with their numbers of messages,
    and `custom_data` has entries beside the usual ones.
    """
    return {
        "version": _VERSION,
        "storage_identifier": "mcap",
        **_span(files),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type_name,
                    "serialization_format": topic.message_encoding,
                    "offered_qos_profiles": list(topic.qos_profiles),
                    "type_description_hash": topic.type_hash,
                },
                "message_count": count,
            }
            for topic, count in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [{"path": file.name, **_span([file])} for file in files],
        "custom_data": dict(custom_data) or None,
        "ros_distro": "jazzy",
    }


def write_metadata(directory: FilePath, information: Mapping[str, Any]) -> None:
    """Write a whole metadata.yaml in one step; after an OSError the one before is still there."""
    content = yaml.dump(
        {"rosbag2_bagfile_information": dict(information)},
        Dumper=_PlainDumper,
        sort_keys=False,
        allow_unicode=True,
    )
    temporary = directory / f"{NAME}.tmp"
    try:
        temporary.write_text(content, encoding="utf-8")
        temporary.replace(directory / NAME)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise


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
        """Return True: write everything out."""
        return True
