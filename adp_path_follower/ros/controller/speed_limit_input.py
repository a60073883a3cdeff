"""The topic `speed_limit`: it sets the parameter of that name."""

import contextlib
import math
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Float64

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import update


class SpeedLimitInput:
    """Sets the parameter, so that whoever asks for it sees what holds."""

    def __init__(
        self, node: Node, settings: Callable[[], Settings], answer: Callable[[str], None]
    ) -> None:
        """Subscribe; `answer` gets why each limit cannot hold, empty if it does."""
        self._node, self._settings, self._answer = node, settings, answer
        self._kinds: dict[str, tuple[type, Callable[[Any], None]]] = {
            "std_msgs/msg/Float64": (Float64, lambda message: self._set(message.data))
        }
        with contextlib.suppress(ImportError):
            from nav2_msgs.msg import SpeedLimit

            self._kinds["nav2_msgs/msg/SpeedLimit"] = SpeedLimit, self._receive_of_nav2
        self._subscribe("std_msgs/msg/Float64")

    def destroy(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    @property
    def types(self) -> tuple[str, ...]:
        """Return the types of message that are understood."""
        return tuple(self._kinds)

    def match(self) -> None:
        """Subscribe with the type that is published; one DDS participant cannot use both."""
        name = self._node.resolve_topic_name("speed_limit")
        offered = {info.topic_type for info in self._node.get_publishers_info_by_topic(name)}
        if len(offered) == 1 and self._type not in offered and offered <= {*self._kinds}:
            self.destroy()
            self._subscribe(*offered)

    def _subscribe(self, name: str) -> None:
        self._type, (kind, receive) = name, self._kinds[name]
        self._subscription: Any = self._node.create_subscription(kind, "speed_limit", receive, 1)

    def _receive_of_nav2(self, message: Any) -> None:
        """Take a limit in m/s, or in percent of the highest speed; 0 is none there."""
        limit = message.speed_limit
        if message.percentage:
            limit *= 0.01 * self._settings().limits.max_linear_vel
        self._set(limit or math.inf)

    def _set(self, limit: float) -> None:
        try:
            update(self._settings(), {"speed_limit": limit})  # says it better than ROS does
            (result,) = self._node.set_parameters([Parameter("speed_limit", value=limit)])
            problem = "" if result.successful else result.reason
        except SettingsError as error:
            problem = str(error)
        self._answer(problem and f"speed limit rejected: {problem}")
