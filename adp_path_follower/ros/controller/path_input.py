"""Paths come in from the topic `path` and from goals: prepared aside, then taken or rejected.

The control thread hands over bytes and takes a route; a newer path supersedes an older one.
"""

import contextlib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

from nav_msgs.msg import Path as PathMessage
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node

from adp_path_follower.core.path.route import Route
from adp_path_follower.core.settings.groups import PathSettings
from adp_path_follower.messages.raw import frame_of, is_empty
from adp_path_follower.ros.controller.path_process import Fit, reason, route_of_message
from adp_path_follower.ros.runtime.path_frame import PathFrame
from adp_path_follower.ros.runtime.qos import EVERY_STEP, LATCHED

_BENDS_MORE = 3.0  # times its poses: a path that does is told of


@dataclass(frozen=True, eq=False)
class PathRequest:
    """A path to be read; the same path that comes again is another request."""

    raw: bytes = field(repr=False)  # A serialised nav_msgs/Path
    settings: PathSettings  # settings to prepare it with
    goal: object = None  # the goal of an action that it is for, None from the topic


@dataclass(frozen=True)
class PathAnswer:
    """The outcome of a path request."""

    request: PathRequest  # the request
    frame: str  # frame of the path
    route: Route | None = None  # the route in that frame; None if it was rejected
    problem: str = ""  # why it was rejected, empty if it was not

    def is_same(self, other: "PathAnswer") -> bool:
        """Return whether another answer has the same route in the same frame."""
        if self.route is None or other.route is None:
            return False
        return self.frame == other.frame and self.route.digest() == other.route.digest()

    @property
    def text(self) -> str:
        """Return what the route is, in words."""
        if self.route is None:
            return self.problem
        backwards = sum(segment.reverse for segment in self.route.segments)
        parts = ["closed" if self.route.closed else "open", f"{self.route.length:.2f} m"]
        if backwards or len(self.route.segments) > 1:
            parts.append(f"{len(self.route.segments)} segments, {backwards} of them in reverse")
        turns = sum(segment.turn_first for segment in self.route.segments)
        if turns:
            parts.append(f"{turns} turned to on the spot")
        bend, asked = self.route.bend, self.route.bend_of_poses
        if bend > _BENDS_MORE * asked:
            parts.append(f"bends by up to {bend:.2g} 1/m, its poses by {asked:.2g}")
        if self.route.goal_heading is not None:
            parts.append(f"to heading {self.route.goal_heading:.2f} rad at the end")
        return f"{', '.join(parts)}, in frame '{self.frame}'"


def answer(request: PathRequest, fit: Fit = route_of_message) -> PathAnswer:
    """Return the route of a path, ready to be driven, or why there is none."""
    frame, settings = "", request.settings
    if request.goal is not None and settings.path_closed == "auto":
        settings = replace(settings, path_closed="open")  # a goal has an end, also at the beginning
    try:
        frame = frame_of(request.raw)
        route = fit(request.raw, settings)
    except Exception as error:  # whatever it is, the next path is another one
        return PathAnswer(request, frame, problem=reason(error))
    return PathAnswer(request, frame, route)


class PathIntake:
    """Answers the latest request in a thread."""

    def __init__(self, ready: Callable[[], None], fit: Fit = route_of_message) -> None:
        """Take what the thread calls: `fit` for each request, `ready` when the latest is done."""
        self._ready, self._fit = ready, fit
        self._thread = ThreadPoolExecutor(1)
        self._latest: Future[PathAnswer] | None = None

    def submit(self, request: PathRequest) -> None:
        """Ask for a route; what was asked before is dropped."""
        self.cancel()
        self._latest = self._thread.submit(answer, request, self._fit)
        self._latest.add_done_callback(self._tell)

    def cancel(self) -> None:
        """Drop what was asked."""
        dropped, self._latest = self._latest, None
        if dropped is not None:
            dropped.cancel()

    def take(self, settings: PathSettings) -> PathAnswer | None:
        """Return the latest answer, once, or None; ask again where the settings have changed."""
        if self._latest is None or not self._latest.done():
            return None
        found, self._latest = self._latest.result(), None
        if settings != found.request.settings:
            self.submit(replace(found.request, settings=settings))
            return None
        return found

    def close(self) -> None:
        """End the thread after what it is at, without waiting for that."""
        self.cancel()
        self._thread.shutdown(wait=False)

    def _tell(self, done: Future[PathAnswer]) -> None:
        if done is self._latest:
            self._ready()


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
