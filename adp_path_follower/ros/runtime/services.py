"""Offers services, guards them against bad requests, and logs failed lifecycle transitions."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from std_srvs.srv import Trigger

# Texts that rclpy raises for wrong requests. Any other error is a defect and ends the node.
_CLIENTS_MISTAKES = ("Transition is not registered", "is not a valid Parameter.Type")


def told_if_it_fails(transition: Callable[..., Any]) -> Callable[..., Any]:
    """Return a lifecycle callback that logs its exception, which rclpy keeps to itself."""

    @functools.wraps(transition)
    def attempt(node: Any, state: Any) -> Any:
        try:
            return transition(node, state)
        except Exception as error:
            text = " ".join(str(error).split())
            node.get_logger().fatal(
                f"{transition.__name__} failed, stopping: {type(error).__name__}: {text}"
            )
            raise

    return attempt


def defend_services(node: Node) -> None:
    """Reject impossible transitions and values of unknown types, at which rclpy would raise."""
    for service in node.services:
        service.callback = _defended(service.callback, service.srv_name, node)


def _defended(callback: Callable[..., Any], name: str, node: Node) -> Callable[..., Any]:
    def answer(request: Any, response: Any) -> Any:
        try:
            return callback(request, response)
        except Exception as error:
            if not any(mistake in str(error) for mistake in _CLIENTS_MISTAKES):
                raise
            reason = " ".join(str(error).split()).split(", at /")[0]
            node.get_logger().error(f"{name} rejected: {reason}")
            if hasattr(response, "results"):  # one for each parameter
                rejected = SetParametersResult(successful=False, reason=reason)
                response.results = [rejected] * len(request.parameters)
            elif hasattr(response, "result"):  # for all of them
                response.result = SetParametersResult(successful=False, reason=reason)
            return response

    return answer


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
