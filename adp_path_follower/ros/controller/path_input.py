"""The topic `path`: what comes in is prepared aside, then taken over, rejected, or removed."""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from nav_msgs.msg import Path as PathMessage
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node

from adp_path_follower.core.settings.groups import PathSettings
from adp_path_follower.messages.raw import is_empty
from adp_path_follower.ros.controller.path_process import Fit
from adp_path_follower.ros.controller.path_worker import PathAnswer, PathIntake, PathRequest
from adp_path_follower.ros.runtime.frames import frame_transform
from adp_path_follower.ros.runtime.qos import LATCHED


class PathInput:
    """Keeps what path is followed, and why the last one is not."""

    def __init__(
        self,
        node: Node,
        settings: Callable[[], PathSettings],
        follow: Callable[[PathAnswer | None], None],
        refuse: Callable[[str], None],
        fit: Fit,
    ) -> None:
        """Subscribe; `follow` gets a path or none, `refuse` a sentence; a thread calls `fit`."""
        self.followed: PathAnswer | None = None
        self.problem = ""  # why the last path was rejected
        self._node, self._settings = node, settings
        self._follow, self._refuse = follow, refuse
        self._odom_frame = ""
        self._refused: PathRequest | None = None  # in the frame that the odometry had then
        self._fitted = node.create_guard_condition(self._take)
        self._intake = PathIntake(frame_transform(node), self._wake, fit)
        self._subscription: Any = node.create_subscription(
            PathMessage, "path", self._receive, LATCHED, raw=True
        )

    def destroy(self) -> None:
        """End the thread, and destroy what was created."""
        self._intake.close()
        self._node.destroy_guard_condition(self._fitted)
        self._node.destroy_subscription(self._subscription)

    def odometry_in(self, frame: str) -> None:
        """Note the odometry's frame; if it changed, ask again for the path, also a rejected one."""
        changed, self._odom_frame = frame != self._odom_frame, frame
        if self.followed is not None and self.followed.followed_frame != frame:
            self._submit(replace(self.followed.request, odom_frame=frame))
            self._change(None)
        elif self._refused is not None and changed:
            self._submit(replace(self._refused, odom_frame=frame))

    def retry(self) -> None:
        """Ask again, now and then, for a path whose transform was not known."""
        self._intake.retry()

    def _wake(self) -> None:
        """Let the node take what the other thread has prepared, if it is still there."""
        with contextlib.suppress(InvalidHandle):
            self._fitted.trigger()

    def _change(self, found: PathAnswer | None) -> None:
        self.followed = found
        self._follow(found)

    def _receive(self, raw: bytes) -> None:
        """Let a path be prepared; an empty one stops at once."""
        if is_empty(raw):
            self._intake.cancel()
            self.problem, self._refused = "", None
            self._change(None)
        else:
            self._submit(PathRequest(raw, self._settings(), self._odom_frame))

    def _submit(self, request: PathRequest) -> None:
        self._refused = None
        self._intake.submit(request)

    def _take(self) -> None:
        """Take over a path that has been prepared, or reject it and go on with the present one."""
        found = self._intake.take(self._settings(), self._odom_frame)
        if found is None:
            return
        self.problem = found.problem
        if found.route is None:
            self._refused = found.request
            self._refuse(found.problem)
            return
        present = None if self.followed is None else self.followed.route
        if present is None or found.route.digest() != present.digest():
            self._change(found)
