"""Where the robot is in the frame of its path, by odometry and the latest transform.

Transforms come from /tf and /tf_static, where `tf2_msgs` is installed. Frames are taken to be
level, as those between a path and odometry are. The latest transform of each pair counts: what it
is at the time of the odometry would be known only later.
"""

import contextlib
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from adp_path_follower.core.driving.moving_frame import MovingFrame
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray, pose_in_frame, tracking_error
from adp_path_follower.core.settings.navigation import NavigationSettings
from adp_path_follower.messages.raw import CdrError, read_transforms, way_between

_TOPICS = {"/tf": DurabilityPolicy.VOLATILE, "/tf_static": DurabilityPolicy.TRANSIENT_LOCAL}
_DEPTH = 100


class FrameError(AdpError):
    """Report a transform that is not known (yet)."""


@dataclass(frozen=True, eq=False)
class FramePlace:
    """The place of a frame in another one."""

    pose: FloatArray  # x [m], y [m], turn [rad], shape (3,)
    stamp: int | None  # time of the oldest transform in it [ns], None where all are static
    between: tuple[str, ...]  # the frames on the way from the one to the other, both ends included


class Frames:
    """Listens to transforms from the first question on."""

    def __init__(self, node: Node) -> None:
        """Do nothing yet; raise ImportError without `tf2_msgs`."""
        from tf2_msgs.msg import TFMessage

        self._node, self._type = node, TFMessage
        self._subscriptions: list[Any] = []
        self._parents: dict[str, str] = {}
        # Child frame -> its pose in its parent (3,), and the stamp [ns], None if static.
        self._edges: dict[str, tuple[FloatArray, int | None]] = {}
        self._known: dict[tuple[str, str], FramePlace] = {}

    def destroy(self) -> None:
        """End the subscriptions."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []

    def place(self, frame: str, within: str) -> FramePlace:
        """Return where a frame is in another one; raise FrameError while that is not known."""
        if not self._subscriptions:
            self._listen()
        found = self._known.get((frame, within))
        if found is None:
            found = self._known[frame, within] = self._found(frame, within)
        return found

    def _listen(self) -> None:
        for topic, durability in _TOPICS.items():
            qos = QoSProfile(depth=_DEPTH, durability=durability)
            take = functools.partial(self._take, topic == "/tf_static")
            self._subscriptions.append(
                self._node.create_subscription(self._type, topic, take, qos, raw=True)
            )

    def _take(self, is_static: bool, raw: bytes) -> None:
        try:
            found = read_transforms(raw)
        except CdrError:
            return
        for item in found:
            if math.isfinite(sum(item.pose)):
                stamp = None if is_static else item.stamp
                self._parents[item.child] = item.parent
                self._edges[item.child] = np.array(item.pose), stamp
        # Most transforms are of joints, which are on no way to a path.
        changed = {item.child for item in found}
        if any(changed.intersection(place.between) for place in self._known.values()):
            self._known.clear()

    def _found(self, frame: str, within: str) -> FramePlace:
        way = way_between(self._parents, frame, within)
        if way is None:
            raise FrameError(f"no transform from '{frame}' to '{within}' is known")
        rising, falling, shared = way
        pose = np.zeros(3)
        for name in rising:
            pose = pose_in_frame(pose, self._edges[name][0])
        for name in falling:
            pose = tracking_error(pose, self._edges[name][0])
        stamps = [self._edges[name][1] for name in (*rising, *falling)]
        oldest = min((stamp for stamp in stamps if stamp is not None), default=None)
        return FramePlace(pose, oldest, (*rising, shared, *falling))


class PathFrame:
    """Brings poses from the frame of the odometry to that of a path."""

    def __init__(self, node: Node, settings: Callable[[], NavigationSettings]) -> None:
        """Begin without odometry; listen to transforms once a path is in another frame."""
        self._node, self._settings = node, settings
        self._frames: Frames | None = None
        with contextlib.suppress(ImportError):  # without `tf2_msgs`
            self._frames = Frames(node)
        self._odometry, self._robot = "", ""  # frames, empty until odometry has come
        self._moving = MovingFrame()
        self._located_in = ""  # the frame that it is about

    def destroy(self) -> None:
        """Stop to listen."""
        if self._frames is not None:
            self._frames.destroy()

    def odometry_in(self, frame: str, robot: str) -> None:
        """Note the frames of the odometry and of the robot."""
        self._odometry, self._robot = frame, robot

    def impossible(self, frame: str) -> str:
        """Return why a path in a frame can never be followed, empty if it may."""
        if not frame or frame.startswith("/"):
            return (
                f"path is in frame '{frame}': set header.frame_id to a name without '/' before it"
            )
        if not self._odometry or frame == self._odometry:
            return ""
        if self._frames is None:
            return (
                f"path is in frame '{frame}', but odometry in '{self._odometry}': publish the path "
                f"in '{self._odometry}', or install tf2_msgs"
            )
        try:
            between = self._frames.place(self._odometry, frame).between
        except FrameError:
            return ""
        if self._robot in between:
            return (
                f"path is in frame '{frame}', which moves with the robot: publish it in "
                f"'{self._odometry}'"
            )
        return ""

    def unknown(self, frame: str) -> str:
        """Return why odometry cannot be brought to a frame at present, empty if it can."""
        if not self._odometry or frame == self._odometry:
            return ""
        problem = self.impossible(frame)
        if problem or self._frames is None:
            return problem
        try:
            place = self._frames.place(self._odometry, frame)
        except FrameError as error:
            return f"path is in frame '{frame}', and {error}: publish the transform"
        tolerance = self._settings().transform_tolerance
        now = int(self._node.get_clock().now().nanoseconds)
        if place.stamp is not None and 1e-9 * (now - place.stamp) > tolerance:
            return (
                f"the transform from '{self._odometry}' to '{frame}' is older than "
                f"transform_tolerance, {tolerance:g} s: publish it more often, or set that higher"
            )
        return ""

    def seen_in(self, frame: str, pose: FloatArray | None) -> FloatArray | None:
        """Return a pose (3,) of the odometry in a frame by the latest transform, None without."""
        if pose is None or not self._odometry or frame == self._odometry:
            return pose
        if self.unknown(frame) or self._frames is None:
            return None
        return pose_in_frame(pose, self._frames.place(self._odometry, frame).pose)

    def correct(self, pose: FloatArray, frame: str) -> str:
        """Take over the latest transform, at a pose (3,) of the odometry; return why not."""
        if frame == self._odometry or self._frames is None:
            return ""
        if frame != self._located_in:
            self._located_in, self._moving = frame, MovingFrame()
        place = self._frames.place(self._odometry, frame)
        moved, turned = self._moving.correction(place.pose, pose)
        far, wide = self._settings().max_correction
        if moved > far or turned > wide:
            return (
                f"the transform from '{self._odometry}' to '{frame}' jumped by {moved:.2f} m and "
                f"{turned:.2f} rad, more than max_correction allows"
            )
        self._moving.take(place.pose, place.stamp, pose)
        return ""

    def located(self, pose: FloatArray, speed: float, frame: str) -> FloatArray:
        """Return a pose (3,) of the odometry, at a speed [m/s], in the frame of the path."""
        if frame == self._odometry or self._frames is None:
            return pose
        return self._moving.located(pose, speed)

    def accept(self) -> None:
        """Take the next transform, whatever it is."""
        self._located_in = ""
