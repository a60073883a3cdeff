"""The unicycle: exact motion under held velocities, with the imperfections of a real robot."""

from collections import deque

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from sim_unicycle.disturbances import drive, moved_pose, on_the_ground, within_limits
from sim_unicycle.odometry import Odometry, Reading
from sim_unicycle.settings import PlantSettings


class Unicycle:
    """One kinematic unicycle, or a batch of them along the leading axes of the pose.

    A command passes through delay, limits of velocity, lag and limits of acceleration to the
    wheels, and through slip, friction and a push to the ground. It is measured after every step.

    Attributes:
        pose: True x [m], y [m], theta [rad], shape (..., 3).
        twist: True v [m/s] and w [rad/s] over the last step, shape (..., 2).
        plant: Imperfections; may be exchanged between two steps, but for the seed.

    """

    def __init__(self, pose: FloatArray, plant: PlantSettings, run: int = 0) -> None:
        """Start at rest at a pose, shape (..., 3); of a batch, `run` is the first one's number."""
        self.pose = np.array(pose, dtype=float)
        self.twist = np.zeros((*self.pose.shape[:-1], 2))
        self.plant = plant
        self._velocity = self.twist  # of the wheels
        self._time = 0.0
        self._pending: deque[tuple[float, FloatArray]] = deque()
        self._effective = self.twist
        self._odometry = Odometry(self.pose, self.twist, plant, run)

    @property
    def time(self) -> float:
        """Return the time since the start [s]."""
        return self._time

    @property
    def arrived(self) -> tuple[Reading, ...]:
        """Return the odometry that arrived with the last step: one, unless delayed or lost."""
        return self._odometry.arrived

    def step(self, command: FloatArray, dt: float) -> None:
        """Move for a time [s] with a command [v, w] held, shape (..., 2)."""
        if dt <= 0.0:
            return
        plant = self.plant
        wanted = within_limits(self._delayed(np.asarray(command, dtype=float)), plant)
        wheels, self._velocity = drive(self._velocity, wanted, dt, plant)
        forward, left, turning = plant.push
        self.twist = on_the_ground(wheels, plant)
        if forward or turning:
            self.twist = self.twist + np.array([forward, turning])
        self.pose = moved_pose(self.pose, self.twist, left, dt)
        self._time += dt
        self._odometry.step(self._time, self.pose, wheels, dt, plant)

    def measured_pose(self) -> FloatArray:
        """Return the pose as odometry reported it last, heading in [-pi, pi), shape (..., 3)."""
        return self._odometry.reading.pose.copy()

    def _delayed(self, command: FloatArray) -> FloatArray:
        """Return the command whose delay is over by now."""
        due = self._time + self.plant.command_delay
        while self._pending and self._pending[-1][0] > due:  # the delay has become shorter
            self._pending.pop()
        self._pending.append((due, command))
        while self._pending and self._pending[0][0] <= self._time + 1e-9:
            self._effective = self._pending.popleft()[1]
        return self._effective
