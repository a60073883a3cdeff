"""The path publisher node: a built-in path or a file as nav_msgs/Path, for late joiners too."""

from collections.abc import Callable
from dataclasses import dataclass

from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node

from adp_path_follower.core.path.library import PATH_HELP, named_points
from adp_path_follower.core.settings.schema import setting
from adp_path_follower.ros.runtime.conversions import poses_message
from adp_path_follower.ros.runtime.parameters import LiveSettings, declare_settings
from adp_path_follower.ros.runtime.qos import LATCHED
from adp_path_follower.ros.runtime.run import Ending, run_node

NODE_NAME = "path_publisher"


@dataclass(frozen=True)
class PublishedPathSettings:
    """Path publisher node."""

    path: str = setting("lissajous", f"Path to publish: {PATH_HELP}.")
    frame_id: str = setting("odom", "Frame of the path.")
    spacing: float = setting(
        0.05,
        "Largest distance between two poses of a built-in path; files are published as they are.",
        unit="m",
        low=0.001,
        high=10.0,
    )


@dataclass(frozen=True)
class PathPublisherSettings:
    """All settings of the path publisher."""

    path_publisher: PublishedPathSettings


class PathPublisherNode(Ending, Node):
    """Publish one path, and again whenever a parameter changes."""

    def __init__(self) -> None:
        super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True)
        settings = declare_settings(self, PathPublisherSettings)
        message = self._message(settings)
        self._publisher = self.create_publisher(PathMessage, "path", LATCHED)
        self._publish(settings, message)
        LiveSettings(self, settings, self._prepare_settings)

    def _message(self, settings: PathPublisherSettings) -> PathMessage:
        published = settings.path_publisher
        poses = named_points(published.path, published.spacing)
        return poses_message(poses, published.frame_id, self.get_clock().now().nanoseconds)

    def _publish(self, settings: PathPublisherSettings, message: PathMessage) -> None:
        self._publisher.publish(message)
        name = settings.path_publisher.path
        self.get_logger().info(f"published path '{name}': {len(message.poses)} poses")

    def _prepare_settings(self, settings: PathPublisherSettings) -> Callable[[], None]:
        message = self._message(settings)
        return lambda: self._publish(settings, message)


def main() -> int:
    """Run the node; return its exit code."""
    return run_node(NODE_NAME, PathPublisherNode)
