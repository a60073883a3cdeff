"""Whether an odometry message can follow the one before it."""

from __future__ import annotations

import math

from adp_path_follower.core.geometry import FloatArray, wrap_angle
from adp_path_follower.core.settings import ControllerSettings

_NANOSECONDS = 1_000_000_000
_FARTHEST = 1e8  # [m] from the origin, as for paths
_FASTEST = 1e4  # [m/s], [rad/s]
_HEADING_TOLERANCE = 1.0  # [rad] beyond what the angular velocity explains


class OdometryCheck:
    """Compares each odometry message with the one before it."""

    def __init__(self) -> None:
        """Begin without a message."""
        self._stamp: int | None = None
        self._pose, self._twist = (0.0, 0.0, 0.0), (0.0, 0.0)
        self._child_frame = ""

    def problem(
        self,
        now: int,
        stamp: int,
        pose: FloatArray,
        twist: FloatArray,
        child_frame: str,
        controller: ControllerSettings,
    ) -> str:
        """Return what is wrong with a message, empty if nothing is.

        After a step back of the stamps, and after a jump, the next message is compared with this
        one, so the fault clears itself when the messages agree again. Another robot frame does not.

        Args:
            now: Present time [ns], 0 if it is not known.
            stamp: Its time [ns].
            pose: x [m], y [m], theta [rad], shape (3,).
            twist: v [m/s], w [rad/s], shape (2,).
            child_frame: The robot's frame.
            controller: Says what is too old, and what is a jump.

        """
        (x, y, theta), (v, w) = pose.tolist(), twist.tolist()
        near, slow = (abs(x) <= _FARTHEST >= abs(y)), (abs(v) <= _FASTEST >= abs(w))
        if not (near and slow):  # also what is not a number
            return (
                f"odometry is no robot's: x {x:.3g} m, y {y:.3g} m, v {v:.3g} m/s, w "
                f"{w:.3g} rad/s: check its units"
            )
        age = (now - stamp) / _NANOSECONDS
        if self._stamp is None:
            self._child_frame = child_frame
        if child_frame != self._child_frame:
            return (
                f"odometry is of '{child_frame}' now, and was of '{self._child_frame}': two "
                "sources on one topic?"
            )
        if now and age > controller.odom_timeout:
            problem = f"odometry is {age:.2f} s old by its stamp: are the clocks synchronised?"
        else:
            problem = self._motion_problem(stamp, (x, y, theta), (v, w), controller)
        self._stamp, self._pose, self._twist = stamp, (x, y, theta), (v, w)
        return problem

    def _motion_problem(
        self,
        stamp: int,
        pose: tuple[float, float, float],
        twist: tuple[float, float],
        controller: ControllerSettings,
    ) -> str:
        """Return how a message does not go with the one before."""
        if self._stamp is None:
            return ""
        tolerance = controller.odom_jump_tolerance
        elapsed = (stamp - self._stamp) / _NANOSECONDS
        if elapsed < 0.0:
            return f"odometry stamps went back by {-elapsed:.3f} s"
        if elapsed > controller.odom_timeout:  # nobody knows what happened meanwhile
            return ""
        explained, turn = (
            elapsed * max(abs(before), abs(now))
            for before, now in zip(self._twist, twist, strict=True)
        )
        moved = math.hypot(pose[0] - self._pose[0], pose[1] - self._pose[1])
        if moved > explained + tolerance:
            return (
                f"odometry jumped by {moved:.2f} m in {elapsed:.3f} s, where its velocity explains "
                f"{explained:.2f} m"
            )
        turned = abs(float(wrap_angle(pose[2] - self._pose[2])))
        if turned > turn + _HEADING_TOLERANCE and math.isfinite(tolerance):
            return (
                f"odometry turned by {turned:.2f} rad in {elapsed:.3f} s, where its velocity "
                f"explains {turn:.2f} rad"
            )
        return ""
