"""The transforms of a simulated robot: from the map by way of odometry to its base."""

from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node

from adp_path_follower.ros.runtime.conversions import quaternion_of
from sim_unicycle.settings import FrameSettings

_DEPTH = 100


class Transforms:
    """Publishes map → odom and odom → base on /tf, where `tf2_msgs` is installed."""

    def __init__(self, node: Node, wanted: bool) -> None:
        """Create the publisher, if it is wanted and possible."""
        self._publisher: Any = None
        if not wanted:
            return
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        self._message = TFMessage
        self._publisher = node.create_publisher(TFMessage, "/tf", _DEPTH)

    def publish(self, odometry: Odometry, settings: FrameSettings, elapsed: float) -> None:
        """Publish the transforms that belong to odometry, a time [s] after the start."""
        if self._publisher is None:
            return
        robot = TransformStamped(header=odometry.header, child_frame_id=odometry.child_frame_id)
        place, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
        robot.transform.translation.x, robot.transform.translation.y = place.x, place.y
        robot.transform.rotation = turn
        found = [robot]
        if settings.map_frame:
            found.append(_map(odometry, settings, elapsed))
        self._publisher.publish(self._message(transforms=found))


def _map(odometry: Odometry, settings: FrameSettings, elapsed: float) -> TransformStamped:
    """Return the place of odometry's frame in the map, a time [s] after the start."""
    place = np.array(settings.map_offset) + elapsed * np.array(settings.map_drift)
    found = TransformStamped(child_frame_id=odometry.header.frame_id)
    found.header.stamp, found.header.frame_id = odometry.header.stamp, settings.map_frame
    found.transform.translation.x, found.transform.translation.y = place[:2].tolist()
    found.transform.rotation = quaternion_of(float(place[2]))
    return found
