"""Odometry of the simulated robot: rate, noise, drift, delay, losses, alike for every controller.

Random numbers depend on seed, run and the number of steps only: not on who measures, how often,
or which other runs and disturbances there are.
"""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray, advance_pose, wrap_angle
from sim_unicycle.settings import PlantSettings

_CHUNK = 2**14  # random numbers that are drawn at once
_NOISE, _DRIFT, _LOSS, _ENCODERS, _JITTER = range(5)  # streams of random numbers for each run


@dataclass(frozen=True)
class Reading:
    """One measurement."""

    time: FloatArray  # time of the measurement [s], shape (...)
    # x [m], y [m], theta [rad] with noise and drift, heading in [-pi, pi), (..., 3).
    pose: FloatArray
    twist: FloatArray  # v [m/s] and w [rad/s] of the encoders, shape (..., 2)


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
        self._reckoned = pose
        self._next = 1.0 / plant.odometry_rate  # when it measures again [s]
        # When each run's message comes, infinite if it is lost or has come; and the message.
        self._due: list[tuple[FloatArray, Reading]] = []
        self._latest = np.full(self._shape, -math.inf)  # of those times
        self._punctual = True  # whether all have come at once
        self.reading = self._measured(0.0, pose, twist, plant)  # the last that has arrived
        self.arrived: tuple[Reading, ...] = (self.reading,)  # with the last step

    def step(
        self, time: float, pose: FloatArray, twist: FloatArray, dt: float, plant: PlantSettings
    ) -> None:
        """Measure a robot after a step of a length [s] that ended at a time [s]."""
        self._drift(dt, plant)
        self._reckoned = advance_pose(self._reckoned, twist[..., 0], twist[..., 1], dt)
        if time + 1e-9 >= self._next:
            period = 1.0 / plant.odometry_rate
            self._next = max(self._next + period, time + 0.5 * period) if period else 0.0
            reading = self._measured(
                time, self._reckoned if plant.dead_reckoning else pose, twist, plant
            )
            late = plant.odometry_delay or plant.odometry_jitter or plant.odometry_drop
            self._punctual = self._punctual and not late
            if self._punctual:
                self.reading, self.arrived = reading, (reading,)
                return
            self._due.append((self._arrival(time, plant), reading))
        self.arrived = ()
        for due, reading in self._due:
            come = due <= time + 1e-9
            if come.any():
                self.reading = reading if come.all() else self._mixed(reading, come)
                self.arrived += (reading,)
                due[come] = math.inf
        self._due = [item for item in self._due if np.isfinite(item[0]).any()]

    def _arrival(self, time: float, plant: PlantSettings) -> FloatArray:
        """Return when a message about a time [s] comes, infinite where it is lost, shape (...)."""
        due = np.full(self._shape, time + plant.odometry_delay)
        if plant.odometry_jitter > 0.0:
            late = plant.odometry_jitter * self._stream(_JITTER).draw()[:, 0]
            due = np.maximum(due + late.reshape(self._shape), time)
        due = self._latest = np.maximum(due, self._latest)
        if plant.odometry_drop > 0.0:
            lost = self._stream(_LOSS).draw() < plant.odometry_drop
            due = np.where(lost.reshape(self._shape), math.inf, due)
        return np.array(due)

    def _mixed(self, reading: Reading, come: np.ndarray) -> Reading:
        """Return a reading of the runs where it has come, of the others the last known values."""
        last, rows = self.reading, come[..., None]
        return Reading(
            np.where(come, reading.time, last.time),
            np.where(rows, reading.pose, last.pose),
            np.where(rows, reading.twist, last.twist),
        )

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
        if any(plant.encoder_noise):
            drawn = self._stream(_ENCODERS).draw()[:, :2].reshape(twist.shape)
            twist = twist + np.array(plant.encoder_noise) * drawn
        return Reading(np.full(self._shape, time), measured, twist)

    def _stream(self, purpose: int) -> _Stream:
        if purpose not in self._streams:
            runs = math.prod(self._shape)
            self._streams[purpose] = _Stream(self._seed, runs, purpose)
        return self._streams[purpose]
