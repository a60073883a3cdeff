"""The recorder node: the topics of a run into a rosbag2 bag."""

import functools
import importlib
import itertools
import time as steady
from datetime import datetime
from pathlib import Path as FilePath
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from std_msgs.msg import Header

from adp_path_follower.bags.writer import BagExistsError, BagWriter, Limits, UnknownTypeError
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.files import expanded
from adp_path_follower.ros.recorder.settings import (
    RecorderSettings,
    is_meant,
    provenance,
    topic_patterns,
)
from adp_path_follower.ros.runtime.parameters import declare_settings
from adp_path_follower.ros.runtime.run import Ending, run_node

NODE_NAME = "recorder"

_NANOSECONDS = 1_000_000_000
_FLUSH_PERIOD = 0.25  # [s], steady: what a kill -9 can lose
_DISCOVERY_PERIOD = 0.1  # [s], steady
_STATUS_PERIOD = 1.0  # [s], steady
_LEAST_LINGER, _MOST_LINGER = 0.3, 5.0  # [s], steady


class RecorderNode(Ending, Node):
    """Writes messages as they were serialised, without decoding."""

    def __init__(self) -> None:
        """Create the bag, and look for topics; SettingsError, or FileError without a new bag."""
        super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True)
        self._last_message = 0.0  # steady [s]
        self._silent: set[int] = set()  # topics without a message so far
        self._settled: set[str] = set()  # topics that need not be looked at again
        self._recorded: dict[str, tuple[int, Subscription]] = {}
        self._cause = ""  # why the recording stopped before its time
        settings = declare_settings(self, RecorderSettings)
        choice = settings.topics
        self._wanted = topic_patterns("topics", choice.topics, self.resolve_topic_name)
        self._unwanted = topic_patterns("exclude", choice.exclude, self.resolve_topic_name)
        self._takes_all = choice.all
        self._writer: BagWriter | None = _new_bag(settings)
        self._bag = self._writer  # for the status, also afterwards
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._status_timer = self.create_timer(_STATUS_PERIOD, self._publish_status, clock=clock)
        self._recording_timers = [
            self.create_timer(_DISCOVERY_PERIOD, self._discover, clock=clock),
            self.create_timer(_FLUSH_PERIOD, self._flush, clock=clock),
        ]
        self.get_logger().info(f"recording to {self._bag.directory}")

    def lingers(self, elapsed: float) -> bool:
        """Return whether messages still come: nodes end together, so the last ones are late."""
        self._status_timer.cancel()
        quiet = steady.monotonic() - self._last_message
        return self._writer is not None and (
            elapsed < _LEAST_LINGER or (quiet < _LEAST_LINGER and elapsed < _MOST_LINGER)
        )

    def last_words(self) -> None:
        """Close the bag, with all that has arrived."""
        if self._writer is None:
            return
        writer, self._writer = self._writer, None
        try:
            writer.close()
        except OSError as error:
            self.failed = True
            self.get_logger().error(
                f"bag {writer.directory} not closed: {error.strerror}; `adp recover` reads what "
                "was written"
            )
            return
        self.get_logger().info(f"recorded {writer.message_count} messages to {writer.directory}")

    def _discover(self) -> None:
        """Subscribe to the topics that have appeared."""
        if self._writer is None:
            return
        found = {name for name, _ in self.get_topic_names_and_types()}
        for topic in sorted(found - self._settled):
            wanted = self._takes_all or is_meant(self._wanted, topic, self.get_namespace())
            if not wanted or is_meant(self._unwanted, topic, self.get_namespace()):
                self._settled.add(topic)
            elif publishers := self.get_publishers_info_by_topic(topic):
                self._settled.add(topic)
                self._begin(self._writer, topic, publishers)

    def _begin(self, writer: BagWriter, topic: str, publishers: list[TopicEndpointInfo]) -> None:
        """Begin to record a topic, or warn that it cannot be recorded."""
        type_name = publishers[0].topic_type
        try:
            kind = _message_class(type_name)
            number = writer.add_topic(
                topic, type_name, [_qos_entry(publisher.qos_profile) for publisher in publishers]
            )
        except FileError as error:
            self.get_logger().warning(f"topic {topic} ({type_name}) is not recorded: {error}")
            return
        self._silent.add(number)
        self._subscribe(topic, number, kind, publishers)

    def _subscribe(
        self, topic: str, number: int, kind: type, publishers: list[TopicEndpointInfo]
    ) -> None:
        subscription = self.create_subscription(
            kind,
            topic,
            functools.partial(self._record, number, topic),
            _matching_qos(publishers),
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(
                incompatible_qos=lambda _: self._resubscribe(topic, kind)
            ),
        )
        self._recorded[topic] = number, subscription

    def _resubscribe(self, topic: str, kind: type) -> None:
        """Ask for less, as another publisher has come that offers less."""
        publishers = self.get_publishers_info_by_topic(topic)
        if publishers and self._writer is not None:
            number, subscription = self._recorded.pop(topic)
            self.destroy_subscription(subscription)
            self._subscribe(topic, number, kind, publishers)

    def _record(self, number: int, topic: str, message: bytes, info: dict[str, int]) -> None:
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
        """Stop recording, close the bag, and log it once; the node goes on."""
        writer, self._writer = self._writer, None
        assert writer is not None
        self.failed = True  # as its exit code says at the end
        self._cause = error.strerror or str(error)
        for timer in self._recording_timers:
            timer.cancel()
        for _, subscription in self._recorded.values():
            self.destroy_subscription(subscription)
        try:
            writer.close()
            saved = f"all {writer.message_count} messages up to then are in the bag"
        except OSError:
            saved = "`adp recover` reads what was written"
        self.get_logger().error(
            f"recording to {writer.directory} stopped: {self._cause}; {saved}; free space or "
            "choose another disk, and start the recorder again"
        )
        self._publish_status()

    def _publish_status(self) -> None:
        failed = bool(self._cause)
        values = {
            "bag": str(self._bag.directory),
            "messages": str(self._bag.message_count),
            "bytes": str(self._bag.size),
            "cause": self._cause,
        }
        status = DiagnosticStatus(
            level=DiagnosticStatus.ERROR if failed else DiagnosticStatus.OK,
            name=self.get_fully_qualified_name(),
            message=f"recording stopped: {self._cause}" if failed else "recording",
            hardware_id="",
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )
        header = Header(stamp=self.get_clock().now().to_msg())
        self._diagnostics.publish(DiagnosticArray(header=header, status=[status]))


def _new_bag(settings: RecorderSettings) -> BagWriter:
    """Return a new bag of the name that is set, or of the next free one with the date."""
    bag = settings.bag
    make = functools.partial(
        BagWriter,
        custom_data=provenance(settings),
        compression=bag.compression,
        limits=Limits(round(bag.max_duration * _NANOSECONDS), bag.max_size),
        background=True,
    )
    if bag.output:
        return make(expanded(bag.output))
    name = datetime.now().strftime("adp_run_%Y_%m_%d-%H_%M_%S")
    for number in itertools.count(2):
        try:
            return make(FilePath(name))
        except BagExistsError:
            name = f"{name.partition('+')[0]}+{number}"
    raise AssertionError("unreachable")


def _message_class(type_name: str) -> Any:
    package, kind, name = type_name.split("/")
    if kind != "msg":
        raise UnknownTypeError("only types named PACKAGE/msg/NAME can be recorded")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise UnknownTypeError(
            f"package {package} does not have it here: install it, or source its workspace"
        ) from None


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
        seconds, nanoseconds = divmod(value.nanoseconds, _NANOSECONDS)
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
