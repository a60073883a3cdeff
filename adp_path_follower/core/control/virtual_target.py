"""The virtual target that moves along the path."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.geometry import FloatArray, clamped, tracking_error
from adp_path_follower.core.path.curve import Path, PathFrame
from adp_path_follower.core.path.speed_profile import SpeedReference
from adp_path_follower.core.settings.groups import TargetSettings

MOST_LEAD = 40.0  # [m] of the robot ahead of the target, or behind it, that sets its speed


class VirtualTarget:
    """The target that moves along the path by s_p' = v_des cos(theta) + k1 s.

    Its speed stays below v_des + k1 40 m: one pose that cannot be must not send it away for good.
    """

    def __init__(
        self,
        path: Path,
        target: TargetSettings,
        arc_length: ArrayLike,
        reference: SpeedReference,
    ) -> None:
        """Start at arc lengths [m] of the path, where the reference says the speed along it."""
        self.arc_length = np.asarray(arc_length, dtype=float)[()]  # one robot: a number [m]
        self._reference = reference
        self.v_des = self._reference.speed(self.arc_length)  # [m/s], (...), or one number
        self._path, self._target = path, target
        self._most_speed = target.desired_speed + target.target_gain * MOST_LEAD
        self.frame: PathFrame  # of the path there, after the first `move`, ...
        self.error: FloatArray  # ... and the robot's error in it, (..., 3)
        self._previous_error: FloatArray | None = None

    def hold(self) -> None:
        """Let no time pass in the next `move`."""
        self._previous_error = None

    def copy(self, target: TargetSettings, reference: SpeedReference) -> VirtualTarget:
        """Return a target at the same place that moves by other settings."""
        other = VirtualTarget(self._path, target, self.arc_length, reference)
        other._previous_error = self._previous_error
        return other

    def move(self, pose: FloatArray, dt: float) -> tuple[PathFrame, FloatArray]:
        """Move over the past dt [s] by Heun's method; return the frame there and e (..., 3)."""
        if self.arc_length.shape != pose.shape[:-1]:  # one start for a batch
            self.arc_length = np.broadcast_to(self.arc_length, pose.shape[:-1])
        if self._previous_error is not None and dt > 0.0:
            self._reference.spend(self.arc_length, dt)
            speed_before = self._speed(self.arc_length, self._previous_error)
            guess = self.arc_length + dt * speed_before
            error = tracking_error(pose, self._path.frame(guess).pose)
            speed_after = self._speed(guess, error)
            self.arc_length = self.arc_length + 0.5 * dt * (speed_before + speed_after)
            if self._reference.stops:
                self.arc_length = np.minimum(self.arc_length, self._path.length)
        self.v_des = self._reference.speed(self.arc_length)
        self.frame = self._path.frame(self.arc_length)
        self.error = self._previous_error = tracking_error(pose, self.frame.pose)
        return self.frame, self.error

    def coming_curvature(self, time: float) -> FloatArray:
        """Return the curvature [1/m] half way to where it will be after a time [s], (...)."""
        assert self._previous_error is not None  # it has moved
        speed = self._speed(self.arc_length, self._previous_error)
        return self._path.curvature(self.arc_length + 0.5 * time * speed)

    def _speed(self, arc_length: FloatArray, error: FloatArray) -> FloatArray:
        v_des = self._reference.speed(arc_length)
        speed = error_dynamics.target_speed(error, self._target, v_des)
        limited: FloatArray = clamped(speed, -self._most_speed, self._most_speed)
        return limited
