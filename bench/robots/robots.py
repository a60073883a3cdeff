"""Robots with the imperfections of real ones: named by seed, as physical parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Robot:
    """A differential drive whose firmware believes other wheels than it has.

    Attributes:
        track: Nominal distance of the wheels [m].
        wheel_radius: Nominal radius of the wheels [m].
        radius_error: Share by which both wheels are larger than nominal.
        track_error: Share by which the track is wider than nominal.
        wheel_difference: Share by which the right wheel is larger than the left one.
        mass: Mass [kg], payload included.
        friction: Coefficient of friction of the floor.
        delay: Time from a command to its effect [s].
        lag: Time constant of the wheels' speed [s].
        ramp: Highest acceleration of a wheel's commanded speed, at its rim [m/s^2].
        odometry_rate: Messages per second [Hz].
        latency: Age of a message when it arrives [s].
        jitter: Standard deviation of this age [s].
        position_noise: Standard deviation of x and y [m].
        heading_noise: Standard deviation of the heading [rad].
        linear_noise: Standard deviation of the measured v [m/s].
        angular_noise: Standard deviation of the measured w [rad/s].
        dead_reckoned: Whether the pose is the integral of the encoders, instead of localised.
        seed: Seed of noise and jitter.

    """

    track: float = 0.3
    wheel_radius: float = 0.05
    radius_error: float = 0.0
    track_error: float = 0.0
    wheel_difference: float = 0.0
    mass: float = 4.0
    friction: float = 0.9
    delay: float = 0.0
    lag: float = 0.0
    ramp: float = math.inf
    odometry_rate: float = 100.0
    latency: float = 0.0
    jitter: float = 0.0
    position_noise: float = 0.0
    heading_noise: float = 0.0
    linear_noise: float = 0.0
    angular_noise: float = 0.0
    dead_reckoned: bool = False
    seed: int = 0

    @property
    def gains(self) -> tuple[float, float, float]:
        """Return k_v, k_w and b [rad/m]: v = k_v v_e, w = k_w w_e + b v_e of encoders' v_e, w_e."""
        half = 0.5 * self.wheel_difference
        left = (1.0 + self.radius_error) * (1.0 - half)
        right = (1.0 + self.radius_error) * (1.0 + half)
        mean, track = 0.5 * (left + right), self.track * (1.0 + self.track_error)
        return mean, mean * self.track / track, (right - left) / track

    @property
    def ramps(self) -> tuple[float, float]:
        """Return how fast v, and w at constant v, change by the wheels' ramp [m/s^2, rad/s^2]."""
        return self.ramp, 2.0 * self.ramp / self.track


TYPICAL = Robot(
    radius_error=-0.02,
    track_error=0.03,
    wheel_difference=0.005,
    delay=0.06,
    lag=0.10,
    ramp=2.5,
    odometry_rate=30.0,
    latency=0.03,
    jitter=0.008,
    position_noise=0.005,
    heading_noise=math.radians(0.5),
    linear_noise=0.01,
    angular_noise=0.02,
)


def random_robot(seed: int) -> Robot:
    """Return a robot drawn from all that a differential drive may be."""
    rng = np.random.default_rng([seed, 1])
    noise = rng.uniform(0.0, 1.0)
    return Robot(
        track=rng.uniform(0.2, 0.5),
        wheel_radius=rng.uniform(0.033, 0.1),
        radius_error=rng.uniform(-0.05, 0.05),
        track_error=rng.uniform(-0.04, 0.04),
        wheel_difference=rng.uniform(-0.01, 0.01),
        mass=rng.uniform(3.0, 20.0),
        friction=rng.choice([0.9, 0.9, 0.3]),
        delay=rng.uniform(0.0, 0.25),
        lag=rng.uniform(0.0, 0.3),
        ramp=rng.uniform(1.0, 5.0),
        odometry_rate=float(rng.choice([10.0, 20.0, 30.0, 50.0, 100.0])),
        latency=rng.uniform(0.0, 0.08),
        jitter=rng.uniform(0.0, 0.01),
        position_noise=0.02 * noise,
        heading_noise=math.radians(2.0) * noise,
        linear_noise=0.02 * rng.uniform(0.0, 1.0),
        angular_noise=0.04 * rng.uniform(0.0, 1.0),
        seed=seed,
    )
