"""Play the odometry and the path of a bag to a live controller, with the bag's clock."""

import time as steady
from collections.abc import Callable, Mapping
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from adp_path_follower.bags.reader import messages_of
from adp_path_follower.core.errors import AdpError
from adp_path_follower.messages.topics import TYPES
from adp_path_follower.ros.runtime.conversions import stamp_nanoseconds

_PATIENCE = 30.0  # [s] for a controller to appear
_NANOSECONDS = 1_000_000_000
_CLOCK_PERIOD = 10_000_000  # [ns] between two messages on /clock, at most
_DELIVERY_TIMEOUT = 1.0  # [s]
_SETTLING = 5.0  # [s] for both sides to find each other
_PATH_PERIOD = 1.0  # [s] between repetitions of the first path

_TYPES = {"odom": Odometry, "path": PathMessage}


def republish(
    bag: FilePath,
    topics: Mapping[str, str],
    begun: int | None,
    rate: float,
    progress: Callable[[float], None],
) -> tuple[int, int]:
    """Publish /clock, odometry and path as they were recorded, by the odometry's stamps.

    `topics` maps "odom" and "path" to their topics in the bag; they are published under these
    names, `rate` seconds of the bag in one second. `begun` is the arrival [ns] of the first command
    to move, None without. Returns the numbers of messages that were published, and that cannot be
    decoded. Raises AdpError if no controller listens, or no odometry can be decoded.
    """
    messages, damaged = recorded_messages(bag, topics, begun)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("adp_replay")
    try:
        return _Player(node).play(messages, rate, progress), damaged
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


class _Player:
    """Publishers of what a controller listens to."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._answered = False
        node.create_subscription(TwistStamped, "cmd_vel", self._take_command, 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._clock = node.create_publisher(Clock, "/clock", 10)
        self._publishers = {
            "odom": node.create_publisher(Odometry, "odom", 100),
            "path": node.create_publisher(PathMessage, "path", latched),
        }

    def play(
        self, messages: list[tuple[int, str, Any]], rate: float, progress: Callable[[float], None]
    ) -> int:
        """Publish messages (time [ns], key, message) in their time; return how many."""
        count = len(messages)
        self._wait_for_controller()
        first, last = messages[0][0], messages[-1][0]
        self._begin(messages)
        begun, clock = steady.monotonic(), first - _CLOCK_PERIOD
        for time, key, message in messages:
            while clock < time:
                clock = min(time, clock + _CLOCK_PERIOD)
                ahead = begun + (clock - first) / (_NANOSECONDS * rate) - steady.monotonic()
                if ahead > 0.0:
                    steady.sleep(ahead)
                self._tell_time(clock)
            self._publish(key, message)
            progress((time - first) / max(1, last - first))
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=_DELIVERY_TIMEOUT))
        return count

    def _begin(self, messages: list[tuple[int, str, Any]]) -> None:
        """Repeat the first path and odometry until they are answered, or for a while.

        Controllers take odometry as it comes: what is said before both sides have found each other
        is lost. A path is not, but DDS may ask for it only seconds later. A controller that waits
        for its timer answers only when time goes on.
        """
        _, first_key, first_message = messages[0]
        time, first = next((time, message) for time, key, message in messages if key == "odom")
        self._tell_time(time)
        until, path_due = steady.monotonic() + _SETTLING, 0.0
        while steady.monotonic() < until and not self._answered:
            if first_key == "path" and steady.monotonic() >= path_due:
                self._publish(first_key, first_message)
                path_due = steady.monotonic() + _PATH_PERIOD
            self._publish("odom", first)
            rclpy.spin_once(self._node, timeout_sec=0.05)

    def _take_command(self, message: TwistStamped) -> None:
        linear, angular = message.twist.linear.x, message.twist.angular.z
        self._answered = self._answered or linear != 0.0 or angular != 0.0

    def _publish(self, key: str, message: Any) -> None:
        self._publishers[key].publish(message)
        if key == "path":  # heard before the odometry that it is for
            self._publishers[key].wait_for_all_acked(Duration(seconds=_DELIVERY_TIMEOUT))

    def _tell_time(self, time: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(time, _NANOSECONDS)
        self._clock.publish(message)

    def _wait_for_controller(self) -> None:
        deadline = steady.monotonic() + _PATIENCE
        while not all(item.get_subscription_count() for item in self._publishers.values()):
            if steady.monotonic() > deadline:
                raise AdpError(
                    f"no controller listens to {self._publishers['odom'].topic_name} and "
                    f"{self._publishers['path'].topic_name} after {_PATIENCE:g} s: start a "
                    "controller, as with: ros2 run adp_path_follower controller --ros-args -p "
                    "use_sim_time:=true"
                )
            rclpy.spin_once(self._node, timeout_sec=0.1)


def recorded_messages(
    bag: FilePath, topics: Mapping[str, str], begun: int | None = None
) -> tuple[list[tuple[int, str, Any]], int]:
    """Return the odometry and the paths of a bag in the order to publish them in.

    `topics` gives the topics of "odom" and "path". Returns time [ns], key and message of each, by
    the clock of the odometry, and the number of messages that cannot be decoded. A path comes at
    the latest with the odometry, the first one before the first command to move, which arrived at
    `begun` [ns]. Raises AdpError if no odometry can be decoded.
    """
    found, damaged = _decoded(bag, {topics[key]: key for key in _TYPES})
    odometry = [(arrival, message) for arrival, key, message in found if key == "odom"]
    if not odometry:
        raise AdpError(f"bag {bag} has no odometry on {topics['odom']} that can be decoded")
    arrivals = np.array([arrival for arrival, _ in odometry])
    stamps = [stamp_nanoseconds(message.header) for _, message in odometry]
    timed = []
    for arrival, key, message in found:
        if key == "odom":
            timed.append((stamp_nanoseconds(message.header), key, message))
        else:
            place = min(int(np.searchsorted(arrivals, arrival)), len(stamps) - 1)
            # A recorder may find the topic of a path that is kept long after the controller did.
            if begun is not None:
                place = min(place, max(int(np.searchsorted(arrivals, begun)) - 1, 0))
                begun = None
            timed.append((stamps[place], key, message))
    # At the same time the path first, as commands to the odometry depend on it.
    return sorted(timed, key=lambda item: (item[0], item[1] == "odom")), damaged


def _decoded(bag: FilePath, keys: Mapping[str, str]) -> tuple[list[tuple[int, str, Any]], int]:
    """Return arrival [ns], key and message of topics -> keys, and how many are damaged."""
    found, damaged = [], 0
    kinds = {topic: TYPES[key][0] for topic, key in keys.items()}
    for arrival, topic, raw in messages_of(bag, lambda topic, kind: kinds.get(topic) == kind):
        key = keys[topic]
        try:
            found.append((arrival, key, deserialize_message(raw, _TYPES[key])))
        except Exception:  # rclpy has no error of its own for a message that is cut
            damaged += 1
    return found, damaged
