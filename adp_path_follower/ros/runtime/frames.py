"""Transforms between frames: tf2 where it is installed, behind one small protocol."""

from typing import Any, Protocol

from rclpy.node import Node
from rclpy.time import Time

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import yaw_of_quaternion


class FrameError(AdpError):
    """Report a transform that is not known (yet)."""


class FrameTransform(Protocol):
    """Knows where frames are."""

    def planar(self, target: str, source: str) -> tuple[float, float, float]:
        """Return x [m], y [m] and turn [rad] of a source frame in a target frame.

        Raises FrameError if it is not known.
        """


class Tf2Transform:
    """Takes transforms from tf2."""

    def __init__(self, node: Node) -> None:
        """Listen to /tf and /tf_static; raise ImportError if tf2_ros is not installed."""
        import tf2_ros  # a real ROS installation has it, the wheels have not

        self._failure: Any = tf2_ros.TransformException
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)

    def planar(self, target: str, source: str) -> tuple[float, float, float]:
        """Return the latest x [m], y [m], turn [rad] of a source frame in a target frame."""
        try:
            found = self._buffer.lookup_transform(target, source, Time()).transform
        except self._failure as error:
            reason = " ".join(str(error).split()).rstrip(".")
            raise FrameError(
                f"path is in frame '{source}', odometry in '{target}', and tf2 does not connect "
                f"them ({reason}): publish the transform"
            ) from None
        turn = yaw_of_quaternion(
            found.rotation.x, found.rotation.y, found.rotation.z, found.rotation.w
        )
        return float(found.translation.x), float(found.translation.y), turn


def frame_transform(node: Node) -> FrameTransform | None:
    """Return what knows the frames, None where tf2 is not installed."""
    try:
        return Tf2Transform(node)
    except ImportError:
        return None
