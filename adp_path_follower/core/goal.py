"""Whether a robot has come to the end of its path, or stands beside it."""

from __future__ import annotations

import numpy as np

from adp_path_follower.core.controller import ControlOutput
from adp_path_follower.core.error_dynamics import tracking_error
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path import Path
from adp_path_follower.core.settings import MotionSettings

_STANDING = np.array([0.02, 0.1])  # [m/s, rad/s]: commands below bring nothing more
_PATIENCE = 10.0  # [s] from the target's arrival until a robot that is not there is given up


class Goal:
    """The end of an open path; a closed one has none.

    Attributes:
        reached: Whether the robot is there, shape (...).
        problem: Why one robot will not get there, empty as long as it may.

    """

    def __init__(self, path: Path, motion: MotionSettings, stops: bool) -> None:
        """Take the end of the path, its tolerances and whether the robot brakes to it."""
        self.reached: np.ndarray = np.zeros((), dtype=bool)
        self.problem = ""
        self._open, self._length = not path.closed, path.length
        self._pose = path.frame(path.length).pose
        self._motion, self._stops = motion, stops
        self._waited = 0.0

    def look(self, pose: FloatArray, output: ControlOutput, dt: float) -> None:
        """Note where robots are, poses (..., 3), and what they were told, dt [s] after the last."""
        if not self._open:
            return
        if not self._stops:
            self.reached = output.arc_length >= self._length
            return
        arrived = output.arc_length >= self._length - self._motion.xy_goal_tolerance
        if not arrived.any():
            self.reached, self._waited = arrived, 0.0
            return
        error = tracking_error(pose, self._pose)
        distance, turn = np.hypot(error[..., 0], error[..., 1]), np.abs(error[..., 2])
        near = distance <= self._motion.xy_goal_tolerance
        near = near & (turn <= self._motion.yaw_goal_tolerance)
        standing = (np.abs(output.command) <= _STANDING).all(axis=-1)
        self.reached = arrived & near & standing
        self._waited += dt
        if self._waited > _PATIENCE and self.reached.ndim == 0 and not near:
            self.problem = (
                f"the robot stands {distance:.3f} m and {turn:.3f} rad from the end of the path, "
                f"beyond xy_goal_tolerance {self._motion.xy_goal_tolerance:g} or "
                f"yaw_goal_tolerance {self._motion.yaw_goal_tolerance:g}"
            )
