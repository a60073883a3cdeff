"""Paths come in: read and fitted by `path_fitting` while the robot drives on.

The control thread hands over bytes and takes a route; a newer path supersedes an older one.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from adp_path_follower.core.path.route import Route
from adp_path_follower.core.settings.groups import PathSettings
from adp_path_follower.messages.raw import frame_of
from adp_path_follower.ros.controller.path_process import Fit, reason, route_of_message

_BENDS_MORE = 3.0  # times its poses: a path that does is told of
_CLOSING_TIME = 0.5  # [s], longer than most paths take


@dataclass(frozen=True, eq=False)
class PathRequest:
    """A path to be read; the same path that comes again is another request."""

    raw: bytes = field(repr=False)  # A serialised nav_msgs/Path
    settings: PathSettings  # settings to prepare it with
    goal: object = None  # the goal of an action that it is for, None from the topic

    def fitted(self, fit: Fit) -> Route:
        """Return the route; a goal has an end, also where that is at the beginning."""
        settings = self.settings
        if self.goal is not None and settings.path_closed == "auto":
            settings = replace(settings, path_closed="open")
        return fit(self.raw, settings)


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
    frame = ""
    try:
        frame = frame_of(request.raw)
        route = request.fitted(fit)
    except Exception as error:  # whatever it is, the next path is another one
        return PathAnswer(request, frame, problem=reason(error))
    return PathAnswer(request, frame, route)


class PathIntake:
    """Answers the latest request in a thread."""

    def __init__(self, ready: Callable[[], None], fit: Fit = route_of_message) -> None:
        """Start the thread, which calls `fit` and `ready`."""
        self._ready, self._fit = ready, fit
        self._changed = threading.Condition()
        self._request: PathRequest | None = None
        self._answer: PathAnswer | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def submit(self, request: PathRequest) -> None:
        """Ask for a route; what was asked before is dropped."""
        with self._changed:
            self._request, self._answer = request, None
            self._changed.notify()

    def cancel(self) -> None:
        """Drop what was asked."""
        with self._changed:
            self._request = self._answer = None

    def take(self, settings: PathSettings) -> PathAnswer | None:
        """Return the latest answer, once, or None; ask again where the settings have changed."""
        with self._changed:
            found, self._answer = self._answer, None
        if found is not None and settings != found.request.settings:
            self.submit(replace(found.request, settings=settings))
            return None
        return found

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
            found = answer(request, self._fit)
            with self._changed:
                done = request
                if self._request is not request or self._closed:
                    continue
                self._answer = found
            self._ready()
