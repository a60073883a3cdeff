"""Simulates a batch of runs on a worker, and measures them."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adp_path_follower import criteria
from adp_path_follower.core.control.interface import ControlOutput
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray, tracking_error
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.nearest import beside
from adp_path_follower.core.settings.groups import CostSettings, PathSettings, Settings
from adp_path_follower.core.settings.schema import update
from adp_path_follower.study.simulation.simulate import SimulationResult, simulate
from adp_path_follower.study.sweeps.request.conditions import PathSource, Robot, RunSettings

MOST_AT_ONCE = 128  # runs that one call simulates, to hide Python's overhead

# Measured columns that are NaN for an impossible run.
MEASURES = ("cost", "cost_ratio", "effort", "cross_track_rms", "cross_track_max", "excitation")
_LAST_SHARE = 0.2  # of a run: its end
_SAMPLING = 0.05  # [s] between two looks
_LONGEST_STEP = 0.5  # [m] of the search for the place beside the robot, from the target's on


@dataclass(frozen=True)
class Batch:
    """Runs that differ in start and noise only."""

    first_run: int  # number of the first run
    settings: Settings  # settings of the controller
    cost: CostSettings  # cost that J and effort are counted with
    source: PathSource  # path to follow
    robot: Robot  # robot that follows it
    starts: FloatArray  # initial errors, shape (B, 3)
    optimal_cost: FloatArray  # J* of each run, shape (B,)
    first_seed: int  # seed of the first run's noise; each next run has the next seed
    run: RunSettings  # duration, rate and learning

    def __len__(self) -> int:
        """Return the number of runs."""
        return len(self.starts)


@dataclass(frozen=True)
class Tracking:
    """The tracking of B runs; places and angles are the true ones."""

    cross_track_rms: FloatArray  # RMS distance from the path after the transient [m], shape (B,)
    cross_track_max: FloatArray  # greatest distance then [m], shape (B,)
    # Until |e| to the virtual target stays below 0.05 [s], infinite where it does not, shape (B,).
    settling_time: FloatArray
    # Whether the run stays within 0.5 m of the path, and within a right angle of its direction,
    # over the last fifth of its time, shape (B,).
    ends_on_path: np.ndarray


class TrackingMeter:
    """Looks at B runs at 20 Hz; its `observe` is what `simulate` calls."""

    def __init__(self, path: Path, runs: int, duration: float, period: float) -> None:
        """Prepare for runs of a duration [s] with control steps of a period [s]."""
        self._path = path
        self._stride = max(1, round(_SAMPLING / period))
        self._period = period
        self._counted_from = criteria.transient(duration)
        self._end_from = (1.0 - _LAST_SHARE) * duration
        self._count = 0
        self._squares = np.zeros(runs)
        self._largest = np.zeros(runs)
        self._unsettled = np.full(runs, -math.inf)
        self._ends_on_path = np.ones(runs, dtype=bool)
        self._last_time = 0.0

    def observe(self, runs: slice, time: float, pose: FloatArray, output: ControlOutput) -> None:
        """Take the true poses of some of the runs, shape (B, 3), at a time [s]."""
        if round(time / self._period) % self._stride:
            return
        with np.errstate(all="ignore"):  # runs that are lost may be anywhere
            error = tracking_error(pose, output.target_pose)
            place = beside(self._path, pose, output.arc_length, _LONGEST_STEP)
        distance, angle = place.cross_track, place.heading
        self._unsettled[runs][~criteria.is_settled(error)] = time
        self._last_time = max(self._last_time, time)
        if time >= self._counted_from:
            self._squares[runs] += distance**2
            self._largest[runs] = np.maximum(self._largest[runs], np.abs(distance))
            self._count += runs.start == 0
        if time >= self._end_from:
            near = np.abs(angle) <= 0.5 * math.pi
            self._ends_on_path[runs] &= near & ~criteria.is_off_path(distance)

    def result(self) -> Tracking:
        """Return what was seen."""
        settling = self._unsettled + self._stride * self._period
        never = self._unsettled >= self._last_time
        return Tracking(
            cross_track_rms=np.sqrt(self._squares / max(1, self._count)),
            cross_track_max=self._largest,
            settling_time=np.where(never, math.inf, np.maximum(settling, 0.0)),
            ends_on_path=self._ends_on_path,
        )


Columns = dict[str, np.ndarray]


def joined(pieces: Sequence[Columns]) -> Columns:
    """Return tables one behind the other: column name -> values."""
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def simulate_batch(batch: Batch) -> Columns:
    """Return the measurements of the runs: column name -> values, shape (B,).

    An impossible run (settings that do not fit the path) is not stable, and its `problem` says why.
    """
    count = len(batch)
    numbers = np.arange(count)
    identity = {
        "run": batch.first_run + numbers,
        "robot_seed": batch.first_seed + numbers,
        "start_s": batch.starts[:, 0],
        "start_y": batch.starts[:, 1],
        "start_theta": batch.starts[:, 2],
    }
    try:
        path = _path(batch.source, batch.settings.path)
        meter = TrackingMeter(path, count, batch.run.duration, 1.0 / batch.run.rate)
        found = _simulated(batch, path, meter)
    except (AdpError, np.linalg.LinAlgError) as error:
        return {
            **identity,
            **dict.fromkeys(MEASURES, np.full(count, math.nan)),
            "optimal_cost": batch.optimal_cost,
            "settling_time": np.full(count, math.inf),
            "stable": np.zeros(count, dtype=bool),
            "problem": np.full(count, str(error), dtype=object),
        }
    seen = meter.result()
    lost = found.failed | ~np.isfinite(found.cost)
    missing = np.where(lost, math.nan, 1.0)
    return {
        **identity,
        "cost": found.cost * missing,
        "optimal_cost": batch.optimal_cost,
        "cost_ratio": found.cost * missing / batch.optimal_cost,
        "effort": found.effort * missing,
        "cross_track_rms": seen.cross_track_rms * missing,
        "cross_track_max": seen.cross_track_max * missing,
        "settling_time": np.where(lost, math.inf, seen.settling_time),
        "excitation": found.excitation,
        "stable": ~lost & seen.ends_on_path,
        "problem": np.full(count, "", dtype=object),
    }


def _simulated(batch: Batch, path: Path, meter: TrackingMeter) -> SimulationResult:
    """Return the runs, with the batch's cost counted and the controller's own cost driving."""
    judged = dataclasses.replace(batch.settings, cost=batch.cost)

    def controller(given: Settings, path: Path, arc_length: FloatArray) -> PathFollower:
        # `given` differs from `judged` where frozen weights were asked for.
        own = update(batch.settings, {"learning": given.learning.learning})
        return PathFollower(own, path, arc_length)

    with np.errstate(all="ignore"):  # runs that are lost overflow, and are marked
        return simulate(
            judged,
            path,
            batch.starts,
            start_arc_length=batch.run.start_arc_length,
            duration=batch.run.duration,
            rate=batch.run.rate,
            learning=batch.run.learning,
            plant=dataclasses.replace(batch.robot.plant, seed=batch.first_seed),
            faults=batch.robot.faults if batch.robot.faults.entries else None,
            controller=controller,
            observe=meter.observe,
        )


@functools.lru_cache(maxsize=16)
def _path(source: PathSource, settings: PathSettings) -> Path:
    return source.path(settings)
