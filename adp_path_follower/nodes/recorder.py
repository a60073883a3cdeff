"""The recorder node: the topics of a run into a rosbag2 bag."""

from __future__ import annotations

import functools
import importlib
import platform
import time as steady
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo

from adp_path_follower import __version__
from adp_path_follower.bags.writer import BagWriter, UnknownTypeError
from adp_path_follower.core.schema import setting
from adp_path_follower.nodes.parameters import declare_settings
from adp_path_follower.nodes.run import Ending, run_node

NODE_NAME = "recorder"
RUN_TOPICS = (
    "odom",
    "ground_truth",
    "cmd_vel",
    "path",
    "path_follower/target",
    "path_follower/tracking_error",
    "path_follower/critic_weights",
    "path_follower/actor_weights",
    "path_follower/bellman_error",
    "path_follower/excitation",
    "path_follower/cost",
    "path_follower/configuration",
    "/diagnostics",
)

_FLUSH_PERIOD = 0.25  # [s], steady: what a kill -9 can lose
_DISCOVERY_PERIOD = 0.1  # [s], steady
_LEAST_LINGER, _MOST_LINGER = 0.3, 5.0  # [s], steady
_FIXED = "the bag is made at the start"


@dataclass(frozen=True)
class BagSettings:
    """Recorder node."""

    output: str = setting(
        "",
        "Directory of the bag, which must not exist yet; empty makes one named by date and time.",
        read_only=_FIXED,
    )
    topics: tuple[str, ...] = setting(
        RUN_TOPICS, "Topics to record, as soon as they appear.", read_only=_FIXED
    )


@dataclass(frozen=True)
class RecorderSettings:
    """All settings of the recorder."""

    bag: BagSettings


class RecorderNode(Ending, Node):
    """Write messages as they were serialised; decode nothing."""

    def __init__(self) -> None:
        """Create the bag and look for the topics."""
        super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True)
        self._last_message = 0.0  # steady [s]
        self._silent: set[int] = set()  # topics without a message so far
        bag = declare_settings(self, RecorderSettings).bag
        name = bag.output or datetime.now().strftime("adp_run_%Y_%m_%d-%H_%M_%S")
        self._writer: BagWriter | None = BagWriter(
            Path(name).expanduser(),
            {"host": platform.node(), "adp_path_follower": __version__},
        )
        self._missing = {self.resolve_topic_name(topic) for topic in bag.topics}
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_DISCOVERY_PERIOD, self._discover, clock=clock)
        self.create_timer(_FLUSH_PERIOD, self._flush, clock=clock)
        self.get_logger().info(f"recording to {self._writer.directory}")

    def lingers(self, elapsed: float) -> bool:
        """Return whether messages are still coming in.

        A launch file ends all nodes at once, so the others' last words come after our signal.
        """
        quiet = steady.monotonic() - self._last_message
        return elapsed < _LEAST_LINGER or (quiet < _LEAST_LINGER and elapsed < _MOST_LINGER)

    def last_words(self) -> None:
        """Close the bag, with all that has arrived."""
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        try:
            writer.close()
        except OSError as error:
            self.get_logger().error(f"bag {writer.directory} not closed: {error.strerror}")
            return
        self.get_logger().info(f"recorded {writer.message_count} messages to {writer.directory}")

    def _discover(self) -> None:
        """Subscribe to the topics that have appeared."""
        for topic in sorted(self._missing):
            publishers = self.get_publishers_info_by_topic(topic)
            if publishers:
                self._missing.discard(topic)
                self._subscribe(topic, publishers)

    def _subscribe(self, topic: str, publishers: list[TopicEndpointInfo]) -> None:
        assert self._writer is not None  # timers end with the node
        type_name = publishers[0].topic_type
        try:
            number = self._writer.add_topic(
                topic, type_name, [_qos_entry(publisher.qos_profile) for publisher in publishers]
            )
            kind = _message_class(type_name)
        except (UnknownTypeError, ImportError, AttributeError) as error:
            self.get_logger().warning(f"topic {topic} ({type_name}) is not recorded: {error}")
            return
        self.create_subscription(
            kind,
            topic,
            functools.partial(self._record, number, topic),
            _matching_qos(publishers),
            raw=True,
        )
        self._silent.add(number)

    def _record(self, number: int, topic: str, message: bytes, info: dict[str, int]) -> None:
        """Write one serialised message."""
        self._last_message = steady.monotonic()
        if number in self._silent:
            self._silent.discard(number)
            self.get_logger().info(f"recording {topic}")
        if self._writer is None:
            return
        try:
            now = self.get_clock().now().nanoseconds
            self._writer.write(number, message, now, info["source_timestamp"])
        except OSError as error:
            self._give_up(error)

    def _flush(self) -> None:
        if self._writer is None:
            return
        try:
            self._writer.flush()
        except OSError as error:
            self._give_up(error)

    def _give_up(self, error: OSError) -> None:
        """Stop recording, say so once, and leave what was written."""
        assert self._writer is not None
        self.get_logger().error(
            f"recording to {self._writer.directory} stopped: {error.strerror}; what was written "
            "up to now stays readable"
        )
        self._writer = None


def _message_class(type_name: str) -> Any:
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def _matching_qos(publishers: list[TopicEndpointInfo]) -> QoSProfile:
    """Return the strictest QoS that all publishers of a topic offer, keeping everything."""
    profiles = [publisher.qos_profile for publisher in publishers]
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=10_000,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=(DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE),
    )


def _qos_entry(profile: QoSProfile) -> dict[str, Any]:
    """Return a QoS profile as rosbag2's metadata spells it."""

    def duration(value: Any) -> dict[str, int]:
        seconds, nanoseconds = divmod(value.nanoseconds, 1_000_000_000)
        return {"sec": seconds, "nsec": nanoseconds}

    return {
        "history": profile.history.name.lower(),
        "depth": profile.depth,
        "reliability": profile.reliability.name.lower(),
        "durability": profile.durability.name.lower(),
        "deadline": duration(profile.deadline),
        "lifespan": duration(profile.lifespan),
        "liveliness": profile.liveliness.name.lower(),
        "liveliness_lease_duration": duration(profile.liveliness_lease_duration),
        "avoid_ros_namespace_conventions": profile.avoid_ros_namespace_conventions,
    }


def main() -> int:
    """Run the node; return its exit code."""
    return run_node(NODE_NAME, RecorderNode)
