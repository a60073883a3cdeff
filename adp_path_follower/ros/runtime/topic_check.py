"""Checks that a node can hear the topics that it expects."""

import time as steady
from collections.abc import Mapping

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible

_PERIOD = 1.0  # [s], steady: to ask costs a tenth of a millisecond


class TopicCheck:
    """Compares publishers with what the node's subscriptions need."""

    def __init__(self, node: Node, expected: Mapping[str, tuple[tuple[str, ...], QoSProfile]]):
        """Take the types and the quality of service of each expected topic."""
        self._node, self._expected = node, expected
        self._known, self._until = "", 0.0

    def problem(self) -> str:
        """Return why a topic is not heard, empty if all are; it is looked for once a second."""
        if steady.monotonic() >= self._until:
            self._until = steady.monotonic() + _PERIOD
            self._known = next(filter(None, map(self._problem, self._expected)), "")
        return self._known

    def _problem(self, topic: str) -> str:
        types, wanted = self._expected[topic]
        name = self._node.resolve_topic_name(topic)
        for info in self._node.get_publishers_info_by_topic(name):
            if info.topic_type not in types:
                return f"{name} has the type {info.topic_type}, but must be {' or '.join(types)}"
            compatible, reason = qos_check_compatible(info.qos_profile, wanted)
            if compatible == QoSCompatibility.ERROR:
                why = reason.removeprefix("ERROR: ").rstrip("; ")
                return f"{name} of {info.node_name} is not heard: {why}"
        return ""
