"""A frame that moves beneath the robot: localisation corrects where odometry has drifted.

The path lies in a frame in which odometry's own frame has a place, the transform. Between two
transforms the robot moves as odometry says. With a new one its pose is another at once, and the
controller's limits decide how fast the command follows. A frame that drifts carries the robot
aside: the heading that counts for the path is then the direction of its motion over ground, so that
steady drift leaves no error.
"""

import math

import numpy as np

from adp_path_follower.core.geometry import FloatArray, pose_in_frame, wrap_angle

_SMOOTHING = 1.0  # [s] of the drift
_STEP = 0.1  # [m] by which a drift may move the robot from one transform to the next
_FASTEST = 0.3  # share of the robot's speed that counts as drift
_SLOW = 0.05  # [m/s]: a robot that stands has no direction of motion


class MovingFrame:
    """Brings poses of odometry into the frame of a path by the latest transform."""

    def __init__(self) -> None:
        self._place: FloatArray | None = None
        self._stamp: int | None = None
        self._drift = np.zeros(2)  # of the robot in the frame of the path [m/s]

    def correction(self, place: FloatArray, pose: FloatArray) -> tuple[float, float]:
        """Return the distance [m] and turn [rad] by which a new transform moves a pose (3,).

        The transform is the place (3,) of the odometry's frame in the frame of the path.
        """
        if self._place is None or place is self._place:
            return 0.0, 0.0
        old, new = pose_in_frame(pose, self._place), pose_in_frame(pose, place)
        return math.dist(old[:2], new[:2]), abs(float(wrap_angle(new[2] - old[2])))

    def take(self, place: FloatArray, stamp: int | None, pose: FloatArray) -> None:
        """Take over a transform of a time [ns], None if it never changes, at a pose (3,)."""
        before, self._place = self._place, place
        last, self._stamp = self._stamp, stamp
        if before is None or stamp is None or last is None or stamp <= last:
            return
        elapsed = 1e-9 * (stamp - last)
        moved = (pose_in_frame(pose, place) - pose_in_frame(pose, before))[:2]
        if float(np.hypot(*moved)) <= _STEP:
            share = -math.expm1(-elapsed / _SMOOTHING)
            self._drift = self._drift + share * (moved / elapsed - self._drift)

    def located(self, pose: FloatArray, speed: float) -> FloatArray:
        """Return a pose (3,) of odometry in the frame of the path, at a speed [m/s] of the robot.

        Its heading is that of the motion over ground.
        """
        assert self._place is not None  # a transform was taken
        found = pose_in_frame(pose, self._place)
        drift = float(np.hypot(*self._drift))
        if abs(speed) < _SLOW or drift == 0.0:
            return found
        slower = min(1.0, _FASTEST * abs(speed) / drift)
        along = speed * np.array([math.cos(found[2]), math.sin(found[2])])
        ground = math.copysign(1.0, speed) * (along + slower * self._drift)
        found[2] += wrap_angle(math.atan2(ground[1], ground[0]) - found[2])
        return found
