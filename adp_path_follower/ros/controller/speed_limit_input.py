"""The topic `speed_limit`: it sets the parameter of that name."""

from collections.abc import Callable

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
        self._subscription = node.create_subscription(Float64, "speed_limit", self._receive, 1)

    def destroy(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    def _receive(self, message: Float64) -> None:
        try:
            update(self._settings(), {"speed_limit": message.data})  # says it better than ROS does
            (result,) = self._node.set_parameters([Parameter("speed_limit", value=message.data)])
            problem = "" if result.successful else result.reason
        except SettingsError as error:
            problem = str(error)
        self._answer(problem and f"speed limit rejected: {problem}")
