"""The entries in the metadata.yaml of a torn bag that still make sense."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

import yaml
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from adp_path_follower.core.files import parse_yaml

_MOST_BYTES = 1024 * 1024  # more is no metadata.yaml; YAML of that size takes seconds to parse


@dataclass(frozen=True)
class TornMetadata:
    """Known metadata of a bag."""

    # Topic -> its QoS profiles.
    qos_profiles: Mapping[str, list[dict[str, Any]]] = field(default_factory=dict)
    type_hashes: Mapping[str, str] = field(default_factory=dict)  # topic -> the hash of its type
    custom_data: Mapping[str, str] = field(default_factory=dict)  # entries that the recorder added
    # Entries that a copy of the bag shares with it.
    kept: Mapping[str, str] = field(default_factory=dict)


def read_torn_metadata(file: FilePath) -> TornMetadata:
    """Return what a metadata.yaml says; nothing if there is none or it cannot be read."""
    try:
        with file.open("rb") as stream:
            text = stream.read(_MOST_BYTES + 1)
        content = parse_yaml(text.decode()) if len(text) <= _MOST_BYTES else None
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        content = None
    information = _mapping(_mapping(content).get("rosbag2_bagfile_information"))
    profiles, hashes = {}, {}
    topics = information.get("topics_with_message_count")
    for entry in topics if isinstance(topics, list) else []:
        topic = _mapping(_mapping(entry).get("topic_metadata"))
        name, type_hash = topic.get("name"), topic.get("type_description_hash")
        if isinstance(name, str):
            profiles[name] = sound_qos_profiles(topic.get("offered_qos_profiles")) or []
            if isinstance(type_hash, str):
                hashes[name] = type_hash
    kept = {}
    if str(information.get("compression_mode")).lower() == "message":
        kept = _texts(information, ("compression_format", "compression_mode"))
    kept |= _texts(information, ("ros_distro",))
    custom = _mapping(information.get("custom_data"))
    return TornMetadata(profiles, hashes, _texts(custom, tuple(custom)), kept)


def sound_qos_profiles(profiles: object) -> list[dict[str, Any]] | None:
    """Return QoS profiles, or those in a YAML text, as Jazzy spells them; None if unsound."""
    if not isinstance(profiles, str | list) or not 0 < len(profiles) <= _MOST_BYTES:
        return None
    try:
        # Our own parser of YAML is ten times as fast as the library's.
        listed: Any = parse_yaml(profiles) if isinstance(profiles, str) else profiles
        found = parse_qos(listed)
    except Exception:  # what the library makes of a damaged text
        return None
    for item in found:
        times = (*item.deadline, *item.lifespan, *item.liveliness_lease_duration)
        if not all(isinstance(number, int) for number in (item.depth, *times)):
            return None
    return [dict(item) for item in dump_qos_v9(found)]


def _mapping(content: object) -> Mapping[Any, Any]:
    return content if isinstance(content, dict) else {}


def _texts(content: Mapping[Any, Any], keys: tuple[Any, ...]) -> dict[str, str]:
    return {
        key: content[key]
        for key in keys
        if isinstance(key, str) and isinstance(content.get(key), str)
    }
