"""Paths come in from the topic `path` and from goals: prepared aside, then taken or rejected."""

import contextlib
from collections.abc import Callable
from typing import Any

from nav_msgs.msg import Path as PathMessage
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node

from adp_path_follower.core.settings.groups import PathSettings
from adp_path_follower.messages.raw import is_empty
from adp_path_follower.ros.controller.path_process import Fit
from adp_path_follower.ros.controller.path_worker import PathAnswer, PathIntake, PathRequest
from adp_path_follower.ros.runtime.path_frame import PathFrame
from adp_path_follower.ros.runtime.qos import EVERY_STEP, LATCHED


class PathInput:
    """Keeps what path is followed, and why the last one is not."""

    def __init__(
        self,
        node: Node,
        settings: Callable[[], PathSettings],
        follow: Callable[[PathAnswer | None], None],
        refuse: Callable[[PathAnswer], None],
        arrived: Callable[[], None],
        frame: PathFrame,
        fit: Fit,
    ) -> None:
        """Subscribe; a thread calls `fit`.

        `follow` gets a path or none, `refuse` one that cannot be followed, and `arrived` is called
        for each on the topic. `frame` knows where odometry is in the frame of a path.
        """
        self.followed: PathAnswer | None = None
        self.problem = ""  # why the last path was rejected
        self._node, self._settings, self._frame = node, settings, frame
        self._follow, self._refuse, self._arrived = follow, refuse, arrived
        self._waiting: PathAnswer | None = None  # until its frame is known
        self._last_sent = 0  # when the last message was published [ns]
        self._fitted = node.create_guard_condition(self._take)
        self._intake = PathIntake(self._wake, fit)
        # One for the last path of latched publishers, one for those that latch nothing.
        self._subscriptions: list[Any] = [
            node.create_subscription(
                *(PathMessage, "path", self._receive, qos),
                raw=True,
                # rclpy would warn of each publisher that only the other one hears.
                event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            )
            for qos in (LATCHED, EVERY_STEP)
        ]

    def destroy(self) -> None:
        """End the thread, and destroy what was created."""
        self._intake.close()
        self._node.destroy_guard_condition(self._fitted)
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)

    @property
    def goal(self) -> object:
        """Return the goal whose path is followed, None without one."""
        return None if self.followed is None else self.followed.request.goal

    def missing_frame(self) -> str:
        """Return why the robot is not known in the frame of its path, empty if it is."""
        return "" if self.followed is None else self._frame.unknown(self.followed.frame)

    def submit(self, raw: bytes, goal: object = None) -> None:
        """Let a serialised path be prepared, from the topic or for a goal."""
        self._waiting = None
        self._intake.submit(PathRequest(raw, self._settings(), goal))

    def stop(self) -> None:
        """Follow nothing any more."""
        self._intake.cancel()
        self.problem, self._waiting = "", None
        self._change(None)

    def retry(self) -> None:
        """Look again for the frame of a path that waits for it."""
        if self._waiting is not None and not self._frame.unknown(self._waiting.frame):
            found, self._waiting = self._waiting, None
            self._change(found)

    def _wake(self) -> None:
        """Let the node take what the other thread has prepared, if it is still there."""
        with contextlib.suppress(InvalidHandle):
            self._fitted.trigger()

    def _change(self, found: PathAnswer | None) -> None:
        if found is not None:
            self.problem = ""
        self.followed = found
        self._follow(found)

    def _receive(self, raw: bytes, info: dict[str, int]) -> None:
        """Let a path be prepared; an empty one stops at once."""
        if info["source_timestamp"] == self._last_sent:  # the other subscription had it
            return
        self._last_sent = info["source_timestamp"]
        self._arrived()
        if is_empty(raw):
            self.stop()
        else:
            self.submit(raw)

    def _take(self) -> None:
        """Take over a path that has been prepared, or reject it and go on with the present one."""
        found = self._intake.take(self._settings())
        if found is None:
            return
        self.problem = found.problem or self._frame.impossible(found.frame)
        if found.route is None or self.problem:
            self._waiting = None if found.route is None else found  # for odometry in its frame
            self._refuse(found)
            return
        present = self.followed
        if present is not None and found.is_same(present):
            self.followed = found
            return
        missing = self._frame.unknown(found.frame)
        # Whoever sent a goal waits for its own path, and is told when that takes too long.
        if missing and present is not None and found.request.goal is None:
            self._waiting = found
            self._node.get_logger().info(
                f"the new path waits, and the present one stays: {missing}"
            )
        else:
            self._change(found)
