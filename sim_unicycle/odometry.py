"""Odometry of the simulated robot: noise, drift, delay and losses, the same for every controller.

Random numbers depend on seed, run and the number of steps only: not on who measures, how often,
or which other runs and disturbances there are.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adp_path_follower.core.geometry import FloatArray, wrap_angle
from sim_unicycle.settings import PlantSettings

Losses = NDArray[np.bool_]

_CHUNK = 2**14  # random numbers that are drawn at once
_NOISE, _DRIFT, _LOSS = range(3)  # streams of random numbers for each run


@dataclass(frozen=True)
class Reading:
    """One measurement."""

    time: float  # time of the measurement [s]
    # x [m], y [m], theta [rad] with noise and drift, heading in [-pi, pi), (..., 3).
    pose: FloatArray
    twist: FloatArray  # v [m/s] and w [rad/s] of the wheels, shape (..., 2)


class _Stream:
    """Random numbers for every run of a batch, each from a generator of its own."""

    def __init__(self, seed: int, runs: int, purpose: int) -> None:
        self._generators = [np.random.default_rng((seed + run, purpose)) for run in range(runs)]
        self._rows = max(1, _CHUNK // max(1, 3 * runs))
        self._normal = purpose != _LOSS
        self._drawn, self._row = np.zeros((0, runs)), 0

    def draw(self) -> FloatArray:
        """Return three normal numbers for each run, (runs, 3), or one in [0, 1) for losses."""
        if self._row == len(self._drawn):
            draws = [
                item.standard_normal((self._rows, 3)) if self._normal else item.random(self._rows)
                for item in self._generators
            ]
            self._drawn, self._row = np.stack(draws, axis=1), 0
        self._row += 1
        row: FloatArray = self._drawn[self._row - 1]
        return row


class Odometry:
    """Measures one robot, or a batch of them along the leading axes of the pose, once a step."""

    def __init__(self, pose: FloatArray, twist: FloatArray, plant: PlantSettings, run: int) -> None:
        """Measure pose (..., 3) and wheels (..., 2) at rest; the first reading arrives at once."""
        self._shape = pose.shape[:-1]
        self._seed = plant.seed + run  # fixed from here on
        self._streams: dict[int, _Stream] = {}
        self._offset = np.zeros(pose.shape)
        self._due: deque[tuple[float, Reading, Losses | None]] = deque()
        self.reading = self._measured(0.0, pose, twist, plant)  # the last that has arrived
        self.arrived: tuple[Reading, ...] = (
            self.reading,
        )  # with the last step, but those that all lost

    def step(
        self, time: float, pose: FloatArray, twist: FloatArray, dt: float, plant: PlantSettings
    ) -> None:
        """Measure a robot after a step of a length [s] that ended at a time [s]."""
        self._drift(dt, plant)
        reading = self._measured(time, pose, twist, plant)
        lost: Losses | None = None
        if plant.odometry_drop > 0.0:
            lost = self._stream(_LOSS).draw() < plant.odometry_drop
        self._due.append((time + plant.odometry_delay, reading, lost))
        arrived = []
        while self._due and self._due[0][0] <= time + 1e-9:
            _, reading, lost = self._due.popleft()
            if lost is None:
                self.reading = reading
            elif lost.all():
                continue
            else:
                self.reading = self._kept(reading, lost.reshape((*self._shape, 1)))
            arrived.append(reading)
        self.arrived = tuple(arrived)

    def _kept(self, reading: Reading, lost: Losses) -> Reading:
        """Return a reading, with the last known values where it was lost."""
        pose = np.where(lost, self.reading.pose, reading.pose)
        return Reading(reading.time, pose, np.where(lost, self.reading.twist, reading.twist))

    def _drift(self, dt: float, plant: PlantSettings) -> None:
        if plant.position_drift > 0.0 or plant.heading_drift > 0.0:
            rate = np.array([plant.position_drift, plant.position_drift, plant.heading_drift])
            walk = self._stream(_DRIFT).draw().reshape(self._offset.shape)
            self._offset = self._offset + math.sqrt(dt) * rate * walk

    def _measured(
        self, time: float, pose: FloatArray, twist: FloatArray, plant: PlantSettings
    ) -> Reading:
        measured = pose + self._offset
        if plant.position_noise > 0.0 or plant.heading_noise > 0.0:
            size = np.array([plant.position_noise, plant.position_noise, plant.heading_noise])
            measured = measured + size * self._stream(_NOISE).draw().reshape(pose.shape)
        measured[..., 2] = wrap_angle(measured[..., 2])
        return Reading(time, measured, twist)

    def _stream(self, purpose: int) -> _Stream:
        if purpose not in self._streams:
            runs = math.prod(self._shape)
            self._streams[purpose] = _Stream(self._seed, runs, purpose)
        return self._streams[purpose]
