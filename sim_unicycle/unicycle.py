"""The unicycle: exact motion under held velocities, with the imperfections of a real robot."""

import math
from collections import deque

import numpy as np

from adp_path_follower.core.geometry import FloatArray, advance_pose
from sim_unicycle.odometry import Odometry, Reading
from sim_unicycle.settings import PlantSettings

_GRAVITY = 9.81  # [m/s^2]


class Unicycle:
    """One kinematic unicycle, or a batch of them along the leading axes of the pose.

    A command passes through delay, limits of velocity, ramp, lag and limits of acceleration to the
    wheels, and through gains, bias, slip, friction and a push to the ground. It is measured after
    every step.
    """

    def __init__(self, pose: FloatArray, plant: PlantSettings, run: int = 0) -> None:
        """Start at rest at a pose, shape (..., 3); of a batch, `run` is the first one's number."""
        self.pose = np.array(pose, dtype=float)  # true
        self.twist = np.zeros((*self.pose.shape[:-1], 2))  # true, over the last step
        self.plant = plant
        self._velocity = self._set = self.twist  # of the wheels, and by the firmware's ramps
        self.time = 0.0  # since the start [s]
        self._pending: deque[tuple[float, FloatArray]] = deque()
        self._effective = self.twist
        self._odometry = Odometry(self.pose, self.twist, plant, run)

    @property
    def plant(self) -> PlantSettings:
        """Return its imperfections, which may change between two steps, but for the seed."""
        return self._plant

    @plant.setter
    def plant(self, plant: PlantSettings) -> None:
        self._plant, model = plant, plant.model
        self._lowest = np.array([plant.min_linear_vel, -plant.max_angular_vel])
        self._highest = np.array([plant.max_linear_vel, plant.max_angular_vel])
        most = min(plant.max_linear_accel, plant.friction * _GRAVITY)
        self._limits = np.array([most, plant.max_angular_accel])
        self._lags = np.array([model.linear_lag, model.angular_lag])
        self._lags_or_limits = bool((self._lags > 0.0).any() or np.isfinite(self._limits).any())

    @property
    def arrived(self) -> tuple[Reading, ...]:
        """Return the odometry that arrived with the last step: one, unless delayed or lost."""
        return self._odometry.arrived

    def step(self, command: FloatArray, dt: float) -> None:
        """Move for a time above 0 [s] with a command [v, w] held, shape (..., 2)."""
        plant, before = self._plant, self._velocity
        wanted = self._delayed(np.asarray(command, dtype=float))
        wanted = np.minimum(np.maximum(wanted, self._lowest), self._highest)
        if min(plant.command_ramps) < math.inf:
            ramps = np.array(plant.command_ramps)
            wanted, self._set = drive(self._set, wanted, dt, np.zeros(2), ramps)
        wheels = self._velocity = wanted
        if self._lags_or_limits:
            wheels, self._velocity = drive(before, wanted, dt, self._lags, self._limits)
        forward, left, turning = plant.push
        self.twist = on_the_ground(wheels, plant)
        if forward or turning:
            self.twist = self.twist + np.array([forward, turning])
        self.pose = moved_pose(self.pose, self.twist, left, dt)
        self.time += dt
        self._odometry.step(self.time, self.pose, wheels, dt, plant)

    def measured_pose(self) -> FloatArray:
        """Return the pose as odometry reported it last, heading in [-pi, pi), shape (..., 3)."""
        return self._odometry.reading.pose.copy()

    def present_pose(self) -> FloatArray:
        """Return that pose moved on to now at the measured velocities, shape (..., 3)."""
        pose, age = self.measured_pose(), self.time - self._odometry.reading.time
        if not (age > 1e-9).any():
            return pose
        twist = self._odometry.reading.twist
        return advance_pose(pose, twist[..., 0], twist[..., 1], age)

    def measured_motion(self) -> FloatArray:
        """Return v and w of the wheels as it reported them, and its age [s], shape (..., 3)."""
        reading = self._odometry.reading
        age = np.asarray(self.time - reading.time)[..., None]
        return np.concatenate([reading.twist, age], axis=-1)

    def _delayed(self, command: FloatArray) -> FloatArray:
        """Return the command whose delay is over by now."""
        due = self.time + self.plant.command_delay
        while self._pending and self._pending[-1][0] > due:  # the delay has become shorter
            self._pending.pop()
        self._pending.append((due, command))
        while self._pending and self._pending[0][0] <= self.time + 1e-9:
            self._effective = self._pending.popleft()[1]
        return self._effective


def drive(
    velocity: FloatArray, wanted: FloatArray, dt: float, lag: FloatArray, limit: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the wheels' mean velocity over a step, and the one at its end, shape (..., 2) each.

    `velocity` and `wanted` are [v, w] at the beginning and as commanded, shape (..., 2); the step
    has a length dt > 0 [s]; lag [s] and limit of acceleration are those of v and of w, shape (2,).
    The exact solution of d(velocity)/dt = clip((wanted - velocity) / lag, -limit, limit): a ramp
    while the gap is large, then the first-order response. With the mean, the distance of a straight
    drive is exact as well.
    """
    bounded, lags = np.isfinite(limit), lag > 0.0
    if not (lags.any() or bounded.any()):
        return wanted, wanted
    gap = velocity - wanted
    slope = np.where(bounded, limit, 1.0)
    reach = np.where(bounded, slope * lag, np.inf)  # the gap that the lag alone closes
    ramp = np.clip((np.abs(gap) - reach) / slope, 0.0, dt)  # [s]
    after_ramp = gap - np.sign(gap) * slope * ramp
    rest = dt - ramp
    exponent = -rest / np.where(lags, lag, 1.0)
    area = 0.5 * ramp * (gap + after_ramp) - after_ramp * lag * np.expm1(exponent)
    fade = np.where(lags, np.exp(exponent), rest <= 0.0)
    return wanted + area / dt, wanted + fade * after_ramp


def on_the_ground(wheels: FloatArray, plant: PlantSettings) -> FloatArray:
    """Return how the robot moves with its wheels' velocities, shape (..., 2)."""
    moved = wheels
    if plant.bias or plant.gains != (1.0, 1.0):
        v, w = plant.model.motion(wheels[..., 0], wheels[..., 1])
        moved = np.stack([v, w], axis=-1)
    if plant.linear_slip > 0.0 or plant.angular_slip > 0.0:
        moved = moved * np.array([1.0 - plant.linear_slip, 1.0 - plant.angular_slip])
    if math.isfinite(plant.friction):
        speed = np.maximum(np.abs(moved[..., 0]), 1e-9)
        turn = np.minimum(np.abs(moved[..., 1]), plant.friction * _GRAVITY / speed)
        moved = np.stack([moved[..., 0], np.copysign(turn, moved[..., 1])], axis=-1)
    return moved


def moved_pose(pose: FloatArray, twist: FloatArray, lateral: float, dt: float) -> FloatArray:
    """Return poses (..., 3) after [v, w], and a velocity to the left [m/s], held for dt [s]."""
    moved = advance_pose(pose, twist[..., 0], twist[..., 1], dt)
    if lateral == 0.0:
        return moved
    # Moving to the left is moving forward with a heading that is a quarter turn further.
    sideways = np.zeros_like(pose)
    sideways[..., 2] = pose[..., 2] + 0.5 * math.pi
    sideways = advance_pose(sideways, np.full(pose.shape[:-1], lateral), twist[..., 1], dt)
    moved[..., :2] += sideways[..., :2]
    return moved
