"""Paths come in: read, transformed and fitted by `path_fitting` while the robot drives on.

The control thread hands over bytes and takes a route; a newer path supersedes an older one.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.path.route import Route
from adp_path_follower.core.settings.groups import PathSettings
from adp_path_follower.messages.raw import frame_of
from adp_path_follower.ros.controller.path_process import Fit, reason, route_of_message
from adp_path_follower.ros.runtime.conversions import wrong_frame
from adp_path_follower.ros.runtime.frames import FrameError, FrameTransform

_RETRY_PERIOD = 1.0  # [s], steady
_BENDS_MORE = 3.0  # times its poses: a path that does is told of
_CLOSING_TIME = 0.5  # [s], longer than most paths take


@dataclass(frozen=True, eq=False)
class PathRequest:
    """A path to be read; the same path that comes again is another request."""

    raw: bytes = field(repr=False)  # A serialised nav_msgs/Path
    settings: PathSettings  # settings to prepare it with
    odom_frame: str  # frame that it is needed in, empty while that is not known


@dataclass(frozen=True)
class PathAnswer:
    """The outcome of a path request."""

    request: PathRequest  # the request
    frame: str  # frame of the message
    route: Route | None = None  # the route in the odometry's frame; None if it was rejected
    # x [m], y [m], turn [rad] of the message's frame in the odometry's, empty if they are the same.
    transform: tuple[float, ...] = ()
    problem: str = ""  # why it was rejected, empty if it was not
    may_come: bool = False  # whether a transform that is not known yet may still come

    @property
    def followed_frame(self) -> str:
        """Return the frame of the route."""
        return self.request.odom_frame if self.transform else self.frame

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
        return f"{', '.join(parts)}, in frame '{self.followed_frame}'"


def answer(
    request: PathRequest, frames: FrameTransform | None, fit: Fit = route_of_message
) -> PathAnswer:
    """Return the route of a path, ready to be driven, or why there is none."""
    frame, transform = "", tuple[float, ...]()
    try:
        frame = frame_of(request.raw)
        if request.odom_frame and frame != request.odom_frame:
            if frames is None:
                raise AdpError(wrong_frame(frame, request.odom_frame))
            transform = frames.planar(request.odom_frame, frame)
        route = fit(request.raw, transform, request.settings)
    except Exception as error:  # whatever it is, the next path is another one
        may_come = isinstance(error, FrameError)
        return PathAnswer(request, frame, problem=reason(error), may_come=may_come)
    return PathAnswer(request, frame, route, transform)


class PathIntake:
    """Answers the latest request in a thread."""

    def __init__(
        self,
        frames: FrameTransform | None,
        ready: Callable[[], None],
        fit: Fit = route_of_message,
    ) -> None:
        """Start the thread, which calls `fit` and `ready`; `frames` is None without tf2."""
        self._frames, self._ready, self._fit = frames, ready, fit
        self._changed = threading.Condition()
        self._request: PathRequest | None = None
        self._answer: PathAnswer | None = None
        self._pending: PathRequest | None = None  # waits for its transform
        self._next_try = 0.0
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def submit(self, request: PathRequest) -> None:
        """Ask for a route; what was asked before is dropped."""
        with self._changed:
            self._request, self._answer, self._pending = request, None, None
            self._changed.notify()

    def cancel(self) -> None:
        """Drop what was asked."""
        with self._changed:
            self._request = self._answer = self._pending = None

    def take(self, settings: PathSettings, odom_frame: str) -> PathAnswer | None:
        """Return the latest answer, once, or None; ask again where settings or frame changed."""
        with self._changed:
            found, self._answer = self._answer, None
        if found is None:
            return None
        wanted = PathRequest(found.request.raw, settings, odom_frame)
        frame = odom_frame or found.frame
        if settings != found.request.settings or frame != (found.request.odom_frame or found.frame):
            self.submit(wanted)
            return None
        self._pending = wanted if found.may_come else None
        self._next_try = time.monotonic() + _RETRY_PERIOD
        return found

    def retry(self) -> None:
        """Ask again, now and then, for a path whose transform was not known."""
        if self._pending is not None and time.monotonic() >= self._next_try:
            pending, self._pending = self._pending, None
            self.submit(pending)

    def close(self) -> None:
        """End the thread after what it is at, which is waited for only briefly."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(_CLOSING_TIME)

    def _work(self) -> None:
        done: PathRequest | None = None
        while True:
            with self._changed:
                while not self._closed and (self._request is None or self._request is done):
                    self._changed.wait()
                if self._closed:
                    return
                request = self._request
            assert request is not None  # it was waited for
            found = answer(request, self._frames, self._fit)
            with self._changed:
                done = request
                if self._request is not request or self._closed:
                    continue
                self._answer = found
            self._ready()
