"""Services that are asked for nothing but to do something."""

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger


def trigger_service(node: Node, name: str, act: Callable[[], str]) -> tuple[Any, Any]:
    """Offer a service that calls `act` and answers its text; return what destroys it, and it."""

    def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = True, act()
        return response

    return node.destroy_service, node.create_service(Trigger, name, answer)
