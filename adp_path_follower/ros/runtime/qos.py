"""Qualities of service of topics, whether they are heard, and messages that must arrive."""

import time as steady
from collections.abc import Callable, Mapping

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, qos_check_compatible

EVERY_STEP = QoSProfile(depth=10)
# For steps that follow odometry, also in lock-step at the machine's pace: a recorder that joins or
# stalls for a second still gets all.
LOSSLESS = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
ALL_CHANGES = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

_PAUSE = 0.01  # [s] between messages that are published several times in any case
_PATIENCE = 0.02  # [s] for one to be delivered, before it is published again
_MOST = 15


def repeat_until_delivered(
    publisher: Publisher, publish: Callable[[], None], least: int = 0
) -> None:
    """Publish a message again, not for long, until all subscribers have got it.

    An undelivered message is lost when its node goes, and Fast DDS asks only every 3 s. `publish`
    is called at least `least` times; 0 if the message has been published.
    """
    for count in range(_MOST):
        if count >= least and publisher.wait_for_all_acked(Duration(seconds=_PATIENCE)):
            return
        publish()
        if count < least:
            steady.sleep(_PAUSE)


def unheard(node: Node, expected: Mapping[str, tuple[tuple[str, ...], QoSProfile]]) -> str:
    """Return why a topic is not heard, empty if all are; it takes a tenth of a millisecond.

    Each expected topic has the types and the quality of service that its subscription needs.
    """
    for topic, (types, wanted) in expected.items():
        name = node.resolve_topic_name(topic)
        for info in node.get_publishers_info_by_topic(name):
            if info.topic_type not in types:
                return f"{name} has the type {info.topic_type}, but must be {' or '.join(types)}"
            compatible, reason = qos_check_compatible(info.qos_profile, wanted)
            if compatible == QoSCompatibility.ERROR:
                why = reason.removeprefix("ERROR: ").rstrip("; ")
                return f"{name} of {info.node_name} is not heard: {why}"
    return ""
