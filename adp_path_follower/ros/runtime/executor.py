"""An executor that answers messages and timers in place."""

from collections.abc import Callable, Iterable
from typing import Any

from rclpy.exceptions import InvalidHandle
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.waitable import NumberOfEntities

_NANOSECONDS = 1_000_000_000


class DirectExecutor(SingleThreadedExecutor):
    """Spin one node, whose messages and timers cost half of what they do in rclpy's executor.

    That one makes a task and a coroutine of each callback and wakes itself twice for it. Here one
    wait set serves until the node has something else to wait for, messages and timers are answered
    at once, and all else is left to rclpy. Callbacks of messages and timers are no coroutines, and
    no other thread destroys what the node has.
    """

    _is_stale = True  # whether the node may have other things to wait for by now

    def __init__(self, node: Node) -> None:
        """Take a node over; raise AttributeError if rclpy lacks an internal that is used here."""
        super().__init__(context=node.context)
        self._node = node
        _check(rclpy_implementation.Timer, "is_timer_ready", "call_timer")
        _check(rclpy_implementation.Subscription, "take_message")
        _check(self, "_context", "_guard", "_tasks")
        self._make_wait_set()
        _check(self._wait_set, "clear_entities", "wait", "get_ready_entities")
        self.add_node(node)

    def wake(self) -> None:
        """Look at what the node has, because something was created or destroyed."""
        self._is_stale = True
        super().wake()

    def spin_once(self, timeout_sec: float | None = None) -> None:
        """Wait for something to do, and do it; ExternalShutdownException after a shutdown."""
        self._require_context()
        if self._is_stale:
            self._is_stale = False
            self._make_wait_set()
        wait_set = self._wait_set
        wait_set.clear_entities()
        for add, handle in self._additions:
            add(handle)
        for waitable in self._waitables:
            waitable.add_to_wait_set(wait_set)
        wait_set.wait(-1 if timeout_sec is None else round(timeout_sec * _NANOSECONDS))
        self._require_context()
        ready = wait_set.get_ready_entities
        guards, services, clients = ready("guard_condition"), ready("service"), ready("client")
        # Whatever else is ready belongs to a waitable, as an action server has services and timers.
        timers = [self._timers[one] for one in ready("timer") if one in self._timers]
        subscriptions = [
            self._subscriptions[one] for one in ready("subscription") if one in self._subscriptions
        ]
        for timer in timers:
            _call(timer)
        for subscription in subscriptions:
            _answer(subscription)
        # Events are looked for where nothing else was ready: they do not go away by themselves.
        quiet = not timers and not subscriptions
        events = quiet and any(waitable.is_ready(wait_set) for waitable in self._waitables)
        if guards or services or clients or self._tasks or events:
            self._leave_to_rclpy(guards)

    def _require_context(self) -> None:
        if not self._context.ok():
            raise ExternalShutdownException

    def _leave_to_rclpy(self, guards: list[int]) -> None:
        """Let rclpy do one thing; guard conditions whose pointers are given were triggered."""
        for guard in self._node.guards:
            if guard.handle.pointer in guards:
                guard.trigger()  # again, for waiting has taken it back
        super().spin_once(0.0)

    def _make_wait_set(self) -> None:
        node = self._node
        self._waitables = [*node.waitables]
        self._timers = _by_pointer(node.timers)
        self._subscriptions = _by_pointer(node.subscriptions)
        for subscription in self._subscriptions.values():
            _check(subscription, "_callback_type", "msg_type", "raw")
        clients, services = [*node.clients], [*node.services]
        guards = [*node.guards, self._guard]
        counts = NumberOfEntities(
            *map(len, (self._subscriptions, guards, self._timers, clients, services))
        )
        for waitable in self._waitables:
            counts += waitable.get_num_entities()
        wait_set = rclpy_implementation.WaitSet(
            counts.num_subscriptions,
            counts.num_guard_conditions,
            counts.num_timers,
            counts.num_clients,
            counts.num_services,
            counts.num_events,
            self._context.handle,
        )
        self._wait_set = wait_set
        self._additions: list[tuple[Callable[[Any], Any], Any]] = [
            (add, entity.handle)
            for add, entities in (
                (wait_set.add_subscription, self._subscriptions.values()),
                (wait_set.add_timer, self._timers.values()),
                (wait_set.add_client, clients),
                (wait_set.add_service, services),
                (wait_set.add_guard_condition, guards),
            )
            for entity in entities
        ]


def executor_of(node: Node) -> SingleThreadedExecutor:
    """Return the executor of a node: rclpy's own where its internals are not those known here."""
    try:
        return DirectExecutor(node)
    except (AttributeError, TypeError) as error:
        node.get_logger().warning(
            f"using rclpy's own executor, which needs more processor time: {error}"
        )
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    return executor


def _check(owner: Any, *names: str) -> None:
    """Raise AttributeError, which says what is missing, unless an object has these attributes."""
    for name in names:
        getattr(owner, name)


def _by_pointer(entities: Iterable[Any]) -> dict[int, Any]:
    """Return entities by what a wait set calls them."""
    return {entity.handle.pointer: entity for entity in entities}


def _call(timer: Timer) -> None:
    """Call a timer's callback, unless it was destroyed or cancelled since it was ready."""
    try:
        with timer.handle:
            if not timer.handle.is_timer_ready():
                return
            timer.handle.call_timer()
    except InvalidHandle:
        return
    timer.callback()


def _answer(subscription: Subscription) -> None:
    """Give the next message to a subscription's callback, unless it was destroyed meanwhile."""
    try:
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
    except InvalidHandle:
        return
    if taken is None:
        return
    if subscription._callback_type is Subscription.CallbackType.MessageOnly:
        subscription.callback(taken[0])
    else:
        subscription.callback(*taken)
