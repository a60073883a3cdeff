"""Which topics of a bag hold the run, by their names and types."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath

from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.bags.definitions import kind_of
from adp_path_follower.core.errors import FileError
from adp_path_follower.messages.topics import NODE, PLAIN, TYPES

_LISTED = 5  # topics in one note
_ASKED = ("odom", "cmd_vel", "path")  # may be named, and are found by type where there is one


@dataclass(frozen=True)
class Choice:
    """The topics that a run is read from."""

    topics: Mapping[str, str]  # key -> topic
    kinds: Mapping[str, str]  # key -> the type of the messages that are read
    notes: tuple[str, ...]  # sentences about what is left out, or taken for want of a better name


class _Bag:
    """The topics of one bag: the messages of each type on each of them."""

    def __init__(self, bag: FilePath, connections: Sequence[Connection]) -> None:
        self.bag = bag
        self.counts: dict[str, dict[str, int]] = {}
        for connection in connections:
            kinds = self.counts.setdefault(connection.topic, {})
            kind = kind_of(connection)
            kinds[kind] = kinds.get(kind, 0) + connection.msgcount
        nodes = {topic.split("/")[-2] for topic in self.counts if topic.endswith("/measured_pose")}
        self.node = nodes.pop() if len(nodes) == 1 else NODE  # it may have another name

    def kind(self, topic: str, allowed: Sequence[str]) -> str:
        """Return the type among those allowed that most messages of a topic have, or ""."""
        kinds = {kind: count for kind, count in self.counts[topic].items() if kind in allowed}
        return max(kinds, key=lambda kind: kinds[kind], default="")

    def of_type(self, allowed: Sequence[str]) -> list[str]:
        return sorted(topic for topic in self.counts if self.kind(topic, allowed))

    def named(self, key: str, name: str) -> str:
        """Return the topic that was asked for; FileError if it is missing or of another type."""
        topic, allowed = f"/{name.removeprefix('/')}", TYPES[key]
        if topic not in self.counts:
            listed = ", ".join(self.of_type(allowed)) or "none"
            raise FileError(
                f"bag {self.bag} has no topic {topic}; of a type that fits are: {listed}"
            )
        if not self.kind(topic, allowed):
            raise FileError(
                f"topic {topic} of bag {self.bag} has the type {' and '.join(self.counts[topic])}, "
                f"but must be {' or '.join(allowed)}"
            )
        return topic

    def by_name(self, key: str, odom: str) -> tuple[str, list[str]]:
        """Return the topic of a key, or "", and notes; FileError if several have its name."""
        allowed = TYPES[key]
        wanted = key if key in PLAIN else f"{self.node}/{key}"
        found = sorted(topic for topic in self.counts if f"/{topic}".endswith(f"/{wanted}"))
        fitting = [topic for topic in found if self.kind(topic, allowed)]
        notes = [
            f"topic {topic} has the type {' and '.join(self.counts[topic])}, not "
            f"{' or '.join(allowed)}: passed over"
            for topic in found
            if topic not in fitting
        ]
        if len(fitting) > 1 and key in _ASKED:
            option = key.removesuffix("_vel")
            raise FileError(
                f"bag {self.bag} has several topics named {key}: say which by --{option}, one of "
                + ", ".join(fitting)
            )
        if len(fitting) > 1:  # several robots: the one whose odometry was chosen
            space = odom.rpartition("/")[0]
            fitting.sort(key=lambda topic: not topic.startswith(f"{space}/"))
            notes.append(f"several topics named {wanted}: {fitting[0]} was taken")
        alone = self.of_type(allowed)
        if not fitting and key in _ASKED and len(alone) == 1:
            fitting = alone
            notes.append(f"no topic is named {key}: {alone[0]} was taken, the only one of its type")
        return (fitting[0] if fitting else ""), notes


def chosen_topics(
    bag: FilePath, connections: Sequence[Connection], names: Mapping[str, str]
) -> Choice:
    """Return which topics of a bag, with all its connections, a run is read from.

    `names` maps a key to the topic to take for it, empty for none. Raises FileError if such a topic
    is missing or has another type, or if it is not clear which one is meant.
    """
    content = _Bag(bag, connections)
    topics: dict[str, str] = {}
    kinds: dict[str, str] = {}
    notes: list[str] = []
    for key, allowed in TYPES.items():
        said: list[str] = []
        if names.get(key) == "":  # not wanted
            continue
        if key in names:
            topic = content.named(key, names[key])
        else:
            topic, said = content.by_name(key, topics.get("odom", ""))
        notes += said
        if not topic:
            continue
        topics[key], kinds[key] = topic, content.kind(topic, allowed)
        notes += [
            f"topic {topic}: {count} messages are {kind}, not {kinds[key]} as the others: left out"
            for kind, count in content.counts[topic].items()
            if kind != kinds[key]
        ]
    return Choice(topics, kinds, (*notes, *_unknown_types(connections)))


def _unknown_types(connections: Sequence[Connection]) -> list[str]:
    """Return a note on the topics that ROS 2 Jazzy has no type or decoder for, none without."""
    known = get_typestore(Stores.ROS2_JAZZY).fielddefs
    unknown = {
        connection.topic: kind_of(connection)
        for connection in connections
        if kind_of(connection) not in known
    }
    if not unknown:
        return []
    listed = [f"{topic} ({kind})" for topic, kind in sorted(unknown.items())[:_LISTED]]
    if len(unknown) > _LISTED:
        listed.append(f"and {len(unknown) - _LISTED} more")
    return [f"topics of types that are not known here: {', '.join(listed)}: passed over"]
