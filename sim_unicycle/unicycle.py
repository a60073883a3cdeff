"""The unicycle: exact motion under held velocities, with the imperfections of a real robot."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from adp_path_follower.core.geometry import FloatArray, advance_pose, wrap_angle
from sim_unicycle.settings import PlantSettings


class Unicycle:
    """One kinematic unicycle, or a batch of them along the leading axes of the pose.

    Attributes:
        pose: True x [m], y [m], theta [rad], shape (..., 3).
        twist: True v [m/s] and w [rad/s] over the last step, shape (..., 2).
        plant: Imperfections; may be exchanged between two steps.

    """

    def __init__(self, pose: FloatArray, plant: PlantSettings) -> None:
        """Start at rest at a pose, shape (..., 3)."""
        self.pose = np.array(pose, dtype=float)
        self.twist = np.zeros((*self.pose.shape[:-1], 2))
        self.plant = plant
        self._velocity = self.twist
        self._random = np.random.default_rng(plant.seed)
        self._time = 0.0
        self._pending: deque[tuple[float, FloatArray]] = deque()
        self._effective = self.twist

    def step(self, command: FloatArray, dt: float) -> None:
        """Move for a time [s] with a command [v, w] held, shape (..., 2)."""
        plant = self.plant
        wanted = self._delayed(np.asarray(command, dtype=float))
        upper = np.array([plant.max_linear_vel, plant.max_angular_vel])
        lower = np.array([plant.min_linear_vel, -plant.max_angular_vel])
        wanted = np.clip(wanted, lower, upper)
        if plant.velocity_lag > 0.0:
            # The mean velocity over the step of a first-order lag, so that the distance is exact.
            ratio = dt / plant.velocity_lag
            fade = -math.expm1(-ratio) / ratio
            self.twist = wanted + fade * (self._velocity - wanted)
            self._velocity = wanted + math.exp(-ratio) * (self._velocity - wanted)
        else:
            self.twist = self._velocity = wanted
        self.pose = advance_pose(self.pose, self.twist[..., 0], self.twist[..., 1], dt)
        self._time += dt

    def measured_pose(self) -> FloatArray:
        """Return the pose as odometry reports it, heading in [-pi, pi), shape (..., 3)."""
        pose = self.pose.copy()
        if self.plant.position_noise > 0.0 or self.plant.heading_noise > 0.0:
            noise = self._random.standard_normal(pose.shape)
            deviation = self.plant.position_noise, self.plant.position_noise
            pose += noise * np.array([*deviation, self.plant.heading_noise])
        pose[..., 2] = wrap_angle(pose[..., 2])
        return pose

    def _delayed(self, command: FloatArray) -> FloatArray:
        """Return the command whose delay is over by now."""
        if self.plant.command_delay <= 0.0:
            return command
        self._pending.append((self._time + self.plant.command_delay, command))
        while self._pending and self._pending[0][0] <= self._time + 1e-9:
            self._effective = self._pending.popleft()[1]
        return self._effective
