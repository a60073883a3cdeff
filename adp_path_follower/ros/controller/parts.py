"""The parts of the controller node between configuration and cleanup."""

from dataclasses import dataclass
from typing import Any

from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from adp_path_follower.ros.controller.commands import Commands, Watchdog
from adp_path_follower.ros.controller.follow_path_action import FollowPathAction
from adp_path_follower.ros.controller.odometry_input import OdometryInput
from adp_path_follower.ros.controller.path_input import PathInput
from adp_path_follower.ros.controller.speed_limit_input import SpeedLimitInput
from adp_path_follower.ros.controller.telemetry import Telemetry
from adp_path_follower.ros.runtime.path_frame import PathFrame
from adp_path_follower.ros.runtime.qos import EVERY_STEP, unheard


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
    watchdog: Watchdog
    entities: list[tuple[Any, Any]]  # pairs of what destroys something of the node, and that

    def topic_problem(self, node: Node) -> str:
        """Return why the controller does not hear what is published for it, empty if it does."""
        expected = {
            "odom": (("nav_msgs/msg/Odometry",), qos_profile_sensor_data),
            "path": (("nav_msgs/msg/Path",), EVERY_STEP),
            "speed_limit": (self.speed_limit.types, EVERY_STEP),
        }
        return unheard(node, expected)

    def destroy(self) -> None:
        """Destroy all of it; what tells the robot to stop goes last."""
        for destroy, entity in self.entities:
            destroy(entity)
        inputs = (self.action, self.speed_limit, self.odometry, self.path, self.frame)
        for part in (self.watchdog, *inputs, self.telemetry):
            part.destroy()
        self.commands.destroy()
