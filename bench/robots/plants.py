"""A plant that moves a `Robot` by formulas: ramp of each wheel, lag, geometry and friction."""

from __future__ import annotations

import heapq
import math
from collections import deque
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from robots import Robot

from adp_path_follower.core.geometry import FloatArray

STEP = 0.002  # [s]
_GRAVITY = 9.81  # [m/s^2]


@dataclass(frozen=True)
class Odometry:
    """Odometry of a time of measurement [s]: pose (3,) and encoders' v, w (2,)."""

    stamp: float
    pose: FloatArray
    twist: FloatArray


class Plant(Protocol):
    """A robot that moves on.

    Attributes:
        pose: True pose, shape (3,).
        twist: True v and w, shape (2,).

    """

    pose: FloatArray
    twist: FloatArray

    def step(self, command: FloatArray) -> None:
        """Move for `STEP` while a command (2,) is being sent."""

    def arrived(self) -> list[Odometry]:
        """Return the odometry that has arrived since the last call."""


class Firmware:
    """Delay and ramp of the commanded wheel speeds."""

    def __init__(self, robot: Robot) -> None:
        """Start at rest."""
        self.robot, self._time = robot, 0.0
        self._pending: deque[tuple[float, float, float]] = deque()
        self._wanted = (0.0, 0.0)
        self.rims = [0.0, 0.0]  # set speeds of the left and right rim [m/s]

    def step(self, command: FloatArray) -> list[float]:
        """Return the set speeds of the rims after `STEP`."""
        v, w = float(command[0]), float(command[1])
        self._pending.append((self._time + self.robot.delay, v, w))
        while self._pending and self._pending[0][0] <= self._time + 1e-9:
            _, v, w = self._pending.popleft()
            self._wanted = (v, w)
        self._time += STEP
        v, w = self._wanted
        half = 0.5 * self.robot.track
        most = self.robot.ramp * STEP
        for side, wanted in enumerate((v - half * w, v + half * w)):
            self.rims[side] += min(max(wanted - self.rims[side], -most), most)
        return self.rims


class Sensors:
    """Odometry at its rate, late and noisy."""

    def __init__(self, robot: Robot, pose: FloatArray) -> None:
        """Start with a pose (3,)."""
        self._robot = robot
        self._rng = np.random.default_rng([robot.seed, 2])
        self._due: list[tuple[float, int, Odometry]] = []
        self._next, self._count = 0.0, 0
        self._reckoned = pose.copy()
        self._last = 0.0

    def step(self, time: float, pose: FloatArray, encoders: tuple[float, float]) -> None:
        """Measure at a time [s] if it is time to."""
        robot, rng = self._robot, self._rng
        if robot.dead_reckoned:
            (v, w), dt = encoders, time - self._last
            middle = self._reckoned[2] + 0.5 * w * dt
            self._reckoned += [v * dt * math.cos(middle), v * dt * math.sin(middle), w * dt]
            pose = self._reckoned
        self._last = time
        if time + 1e-9 < self._next:
            return
        self._next += 1.0 / robot.odometry_rate
        size = robot.position_noise, robot.position_noise, robot.heading_noise
        measured = pose + np.array(size) * rng.standard_normal(3)
        measured[2] = math.remainder(measured[2], math.tau)
        noise = np.array([robot.linear_noise, robot.angular_noise]) * rng.standard_normal(2)
        late = max(0.0, robot.latency + robot.jitter * rng.standard_normal())
        self._count += 1
        found = Odometry(time, measured, np.array(encoders) + noise)
        heapq.heappush(self._due, (time + late, self._count, found))

    def arrived(self, time: float) -> list[Odometry]:
        """Return the messages that have arrived by a time [s]."""
        found = []
        while self._due and self._due[0][0] <= time + 1e-9:
            found.append(heapq.heappop(self._due)[2])
        return found


class AnalyticPlant:
    """Ramp, lag, geometry and friction by formulas."""

    def __init__(self, robot: Robot, pose: FloatArray) -> None:
        """Start at rest at a pose (3,)."""
        self.robot, self.time = robot, 0.0
        self.pose, self.twist = np.array(pose, float), np.zeros(2)
        self._firmware, self._sensors = Firmware(robot), Sensors(robot, self.pose)
        self._rims = [0.0, 0.0]
        half = 0.5 * robot.wheel_difference
        scale = 1.0 + robot.radius_error
        self._sizes = scale * (1.0 - half), scale * (1.0 + half)
        self._fade = math.exp(-STEP / robot.lag) if robot.lag > 0.0 else 0.0
        self._sensors.step(0.0, self.pose, (0.0, 0.0))

    def step(self, command: FloatArray) -> None:
        """Move for `STEP` while a command (2,) is being sent."""
        robot, rims = self.robot, self._rims
        for side, wanted in enumerate(self._firmware.step(command)):
            rims[side] = wanted + self._fade * (rims[side] - wanted)
        left, right = rims[0] * self._sizes[0], rims[1] * self._sizes[1]
        v = 0.5 * (left + right)
        w = (right - left) / (robot.track * (1.0 + robot.track_error))
        grip = robot.friction * _GRAVITY
        w = math.copysign(min(abs(w), grip / max(abs(v), 1e-6)), w)
        x, y, theta = self.pose
        middle = theta + 0.5 * w * STEP
        self.pose = np.array(
            [
                x + v * STEP * math.cos(middle),
                y + v * STEP * math.sin(middle),
                theta + w * STEP,
            ]
        )
        self.twist = np.array([v, w])
        self.time += STEP
        encoders = 0.5 * (rims[0] + rims[1]), (rims[1] - rims[0]) / robot.track
        self._sensors.step(self.time, self.pose, encoders)

    def arrived(self) -> list[Odometry]:
        """Return the odometry that has arrived since the last call."""
        return self._sensors.arrived(self.time)
