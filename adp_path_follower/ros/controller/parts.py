"""The parts of the controller node between configuration and cleanup."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from adp_path_follower.ros.controller.commands import Commands, Watchdog
from adp_path_follower.ros.controller.follow_path_action import FollowPathAction
from adp_path_follower.ros.controller.odometry_input import OdometryInput
from adp_path_follower.ros.controller.path_input import PathInput
from adp_path_follower.ros.controller.speed_limit_input import SpeedLimitInput
from adp_path_follower.ros.controller.telemetry import Telemetry
from adp_path_follower.ros.runtime.path_frame import PathFrame
from adp_path_follower.ros.runtime.qos import EVERY_STEP, TopicCheck


@dataclass(frozen=True)
class ControllerParts:
    """Publishers, subscriptions, services and timers of a configured controller."""

    commands: Commands
    telemetry: Telemetry
    odometry: OdometryInput
    frame: PathFrame
    path: PathInput
    action: FollowPathAction
    speed_limit: SpeedLimitInput
    topics: TopicCheck
    watchdog: Watchdog
    entities: list[tuple[Any, Any]]  # pairs of what destroys something of the node, and that

    def destroy(self) -> None:
        """Destroy all of it; what tells the robot to stop goes last."""
        for destroy, entity in self.entities:
            destroy(entity)
        inputs = (self.action, self.speed_limit, self.odometry, self.path, self.frame)
        for part in (self.watchdog, *inputs, self.telemetry):
            part.destroy()
        self.commands.destroy()


def heard_topics(node: Node, limit: SpeedLimitInput) -> TopicCheck:
    """Return what looks whether the controller hears what is published for it."""
    return TopicCheck(
        node,
        {
            "odom": (("nav_msgs/msg/Odometry",), qos_profile_sensor_data),
            "path": (("nav_msgs/msg/Path",), EVERY_STEP),
            "speed_limit": (limit.types, EVERY_STEP),
        },
    )


def start_teller(log: RcutilsLogger) -> Callable[[str, bool], None]:
    """Return what logs where following begins, and warns where a part of the path is left out."""

    def tell(text: str, left_out: bool) -> None:
        if left_out:
            log.warning(text)
        else:
            log.info(text)

    return tell
