"""Where the robot is in the frame of its path, by odometry and the latest transform."""

import contextlib
from collections.abc import Callable

from rclpy.node import Node

from adp_path_follower.core.driving.moving_frame import MovingFrame
from adp_path_follower.core.geometry import FloatArray, pose_in_frame
from adp_path_follower.core.settings.navigation import NavigationSettings
from adp_path_follower.ros.runtime.frames import FrameError, Frames


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
