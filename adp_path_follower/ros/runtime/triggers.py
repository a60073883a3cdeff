"""Services that are asked for nothing but to do something."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.node import Node
from std_srvs.srv import Trigger


def trigger_services(node: Node, acts: Mapping[str, Callable[[], str]]) -> list[tuple[Any, Any]]:
    """Offer services below ~/ that call what they are mapped to, and answer its text.

    Returns pairs of what destroys a service, and the service.
    """

    def answer(
        act: Callable[[], str], request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        response.success, response.message = True, act()
        return response

    return [
        (
            node.destroy_service,
            node.create_service(Trigger, f"~/{name}", functools.partial(answer, act)),
        )
        for name, act in acts.items()
    ]
