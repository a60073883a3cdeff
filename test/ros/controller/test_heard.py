"""Topics as Nav2 and other nodes publish them: latched or not, of one type or another."""

from __future__ import annotations

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from adp_path_follower.ros.runtime.conversions import poses_message
from live_nodes import Drive

pytestmark = pytest.mark.nodes

LINE = np.column_stack([np.linspace(0.0, 30.0, 301), np.zeros((301, 2))])


def test_a_path_that_is_not_latched_and_a_speed_limit_of_nav2_are_heard(interfaces, peer, start):
    from nav2_msgs.msg import SpeedLimit

    drive = Drive(peer, start)
    volatile = peer.node.create_publisher(PathMessage, "path", 10)
    peer.until_matched(volatile)
    volatile.publish(poses_message(LINE, "odom", 0))
    peer.until(lambda: "new path: open, 30.00 m" in drive.controller.output(), "the path")
    assert drive.controller.output().count("new path") == 2  # the latched one was heard once
    limits = peer.node.create_publisher(SpeedLimit, "speed_limit", 1)
    peer.until_matched(limits)
    # The robot of the test never moves, so the controller wants it to be as fast as it may.
    for percentage, value, lowest, highest in (
        (True, 20.0, 0.199, 0.201),  # of max_linear_vel, 1 m/s
        (False, 0.1, 0.099, 0.101),
        (False, 0.0, 0.3, 1.001),  # none
    ):
        limits.publish(SpeedLimit(percentage=percentage, speed_limit=value))
        peer.until(
            lambda low=lowest, high=highest: low < drive.commands[-1].twist.linear.x < high,
            f"a speed from {lowest} to {highest} m/s",
        )


def test_status_says_which_topic_is_not_heard(drive):
    peer = drive.peer
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    status = peer.listen(DiagnosticStatus, "path_follower/status", latched)
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    for kind, topic, qos, text in (
        (String, "speed_limit", 1, "/speed_limit has the type std_msgs/msg/String"),
        (PathMessage, "path", best_effort, "/path of test_peer is not heard"),
    ):
        publisher = peer.node.create_publisher(kind, topic, qos)
        peer.until(lambda text=text: status and text in status[-1].message, text)
        assert status[-1].level == DiagnosticStatus.WARN
        peer.node.destroy_publisher(publisher)
        peer.until(lambda: status and status[-1].level == DiagnosticStatus.OK, "the end of it")
    drive.until_moving()
