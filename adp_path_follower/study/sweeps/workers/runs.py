"""Simulates a batch of runs on a worker, and measures them."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import CostSettings, PathSettings, Settings
from adp_path_follower.core.settings.schema import update
from adp_path_follower.study.simulation.simulate import SimulationResult, simulate
from adp_path_follower.study.sweeps.request.conditions import PathSource, Robot, RunSettings
from adp_path_follower.study.sweeps.workers.tracking import TrackingMeter

MOST_AT_ONCE = 128  # runs that one call simulates, to hide Python's overhead

# Measured columns that are NaN for an impossible run.
MEASURES = ("cost", "cost_ratio", "effort", "cross_track_rms", "cross_track_max", "excitation")


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
