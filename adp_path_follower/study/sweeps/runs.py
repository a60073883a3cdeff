"""Simulates runs of a sweep or a tuning on a worker, and measures them."""

import dataclasses
import functools
import math
import time
from collections.abc import Mapping, Sequence

import numpy as np

from adp_path_follower import criteria
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.driving.output import ControlOutput
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.nearest import beside
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.schema import Value, update
from adp_path_follower.study.simulation.simulate import simulate
from adp_path_follower.study.sweeps.conditions import Conditions, PathSource, Robot
from adp_path_follower.study.sweeps.objectives import Score, score_of_runs
from adp_path_follower.study.sweeps.request import Sweep

# Measured columns that are NaN for an impossible run.
MEASURES = ("cost", "effort", "cross_track_rms", "cross_track_max", "excitation")
_LAST_SHARE = 0.2  # of a run: its end
_SAMPLING = 0.05  # [s] between two looks
_SHORT, _LONG = 0.3, 0.9  # [s] of simulated time, to measure the computing time
_LONGEST_STEP = 0.5  # [m] of the search for the place beside the robot, from the target's on

Columns = dict[str, np.ndarray]


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
        self._ends_on_path = np.ones(runs, dtype=bool)

    def observe(self, runs: slice, time: float, pose: FloatArray, output: ControlOutput) -> None:
        """Take the true poses of some of the runs, shape (B, 3), at a time [s]."""
        if round(time / self._period) % self._stride:
            return
        with np.errstate(all="ignore"):  # runs that are lost may be anywhere
            place = beside(self._path, pose, output.arc_length, _LONGEST_STEP)
        distance, angle = place.cross_track, place.heading
        if time >= self._counted_from:
            self._squares[runs] += distance**2
            self._largest[runs] = np.maximum(self._largest[runs], np.abs(distance))
            self._count += runs.start == 0
        if time >= self._end_from:
            near = np.abs(angle) <= 0.5 * math.pi
            self._ends_on_path[runs] &= near & ~criteria.is_off_path(distance)

    def columns(self) -> Columns:
        """Return the table's columns of distance and stability, shape (B,) each.

        A run is stable that stays within 0.5 m of the path, and within a right angle of its
        direction, over the last fifth of its time.
        """
        return {
            "cross_track_rms": np.sqrt(self._squares / max(1, self._count)),
            "cross_track_max": self._largest,
            "stable": self._ends_on_path,
        }


def joined(pieces: Sequence[Columns]) -> Columns:
    """Return tables one behind the other: column name -> values."""
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


def check_paths(conditions: Conditions, settings: Settings) -> None:
    """Raise AdpError before the long work if the controller cannot follow one of the paths."""
    for source in conditions.paths:
        try:
            PathFollower(settings, source.path(settings.path), np.zeros(1))
        except AdpError as error:
            raise AdpError(f"path '{source.name}' cannot be followed: {error}") from None


def seconds_each(conditions: Conditions, settings: Sequence[Settings]) -> float:
    """Return the computing time of a run on one worker [s], from a few runs with some settings."""
    runs = np.arange(conditions.runs)[: conditions.part_size]

    def timed(duration: float) -> float:
        run = dataclasses.replace(conditions.run, duration=duration)
        short = dataclasses.replace(conditions, run=run)
        begun = time.perf_counter()
        for some in settings:
            simulate_runs(short, some, runs)
        return (time.perf_counter() - begun) / (len(settings) * len(runs))

    timed(_SHORT)  # fills caches
    # Making the controller costs time once, control steps cost time again and again.
    short, long = timed(_SHORT), timed(_LONG)
    rate = max(0.0, long - short) / (_LONG - _SHORT)
    return short + rate * max(0.0, conditions.run.duration - _SHORT)


def run_part(sweep: Sweep, number: int) -> Columns:
    """Return the table of a part of a sweep: column name -> values, one for each run in order."""
    runs, each = np.asarray(sweep.runs_of(number)), sweep.conditions.runs
    pieces = []
    for some in np.split(runs, np.flatnonzero(np.diff(runs // each)) + 1):
        combination = int(some[0]) // each
        varied = {
            name: str(value) if isinstance(value, tuple) else value
            for name, value in sweep.varied(combination).items()
        }
        known = {"run": some, **_constant(len(some), {"combination": combination, **varied})}
        found = simulate_runs(sweep.conditions, sweep.settings(combination), some % each)
        pieces.append({**known, **found})
    return joined(pieces)


def score_settings(conditions: Conditions, settings: Settings) -> Score:
    """Simulate all runs with some settings, and return their score."""
    pieces = np.split(
        np.arange(conditions.runs),
        range(conditions.part_size, conditions.runs, conditions.part_size),
    )
    return score_of_runs(joined([simulate_runs(conditions, settings, some) for some in pieces]))


def simulate_runs(conditions: Conditions, settings: Settings, runs: np.ndarray) -> Columns:
    """Return the measurements of some runs (N,) with the same settings: column name -> values.

    An impossible run (settings that do not fit the path) is not stable, and its `problem` says why.
    """
    group, place = np.divmod(runs, conditions.runs_each)
    noise, start = np.divmod(place, len(conditions.starts))
    noise_seed = np.asarray(conditions.noise_seeds)[noise]
    robot_seed = noise_seed * len(conditions.starts) + start
    # Runs on the same path with the same robot are simulated at once if their seeds follow.
    ends = np.flatnonzero((np.diff(robot_seed) != 1) | (np.diff(group) != 0)) + 1
    pieces = []
    for some in np.split(np.arange(len(runs)), ends):
        path, number = divmod(int(group[some[0]]), len(conditions.robots))
        source, robot = conditions.paths[path], conditions.robots[number]
        starts, seeds = conditions.starts[start[some]], robot_seed[some]
        known = {
            **_constant(len(some), {"path": source.name, "robot": robot.name}),
            "noise_seed": noise_seed[some],
            "start": start[some],
            **dict(zip(("start_s", "start_y", "start_theta"), starts.T, strict=True)),
            "robot_seed": seeds,
            "optimal_cost": conditions.optimal_costs(settings, source)[start[some]],
        }
        seeded = dataclasses.replace(robot.plant, seed=int(seeds[0]))
        robot = dataclasses.replace(robot, plant=seeded)
        pieces.append({**known, **_measured(conditions, settings, source, robot, starts)})
    columns = joined(pieces)
    return {**columns, "cost_ratio": columns["cost"] / columns["optimal_cost"]}


def _constant(count: int, values: Mapping[str, Value]) -> Columns:
    """Return a column for each of some values that all runs share."""
    return {
        name: np.full(count, value, dtype=object if isinstance(value, str) else None)
        for name, value in values.items()
    }


def _measured(
    conditions: Conditions, settings: Settings, source: PathSource, robot: Robot, starts: FloatArray
) -> Columns:
    """Return the measured columns of runs from the starts (B, 3), shape (B,) each."""
    count, asked = len(starts), conditions.run
    nothing = {
        **_constant(count, dict.fromkeys(MEASURES, math.nan)),
        **_constant(count, {"settling_time": math.inf, "stable": False}),
    }

    def controller(given: Settings, path: Path, arc_length: FloatArray) -> PathFollower:
        # The conditions' cost is counted, the settings' own cost drives. `given` differs from them
        # where frozen weights were asked for, too.
        own = update(settings, {"learning": given.learning.learning})
        return PathFollower(own, path, arc_length)

    try:
        path = _path(source, settings.path)
        meter = TrackingMeter(path, count, asked.duration, 1.0 / asked.rate)
        with np.errstate(all="ignore"):  # runs that are lost overflow, and are marked
            found = simulate(
                dataclasses.replace(settings, cost=conditions.settings.cost),
                path,
                starts,
                start_arc_length=asked.start_arc_length,
                duration=asked.duration,
                rate=asked.rate,
                learning=asked.learning,
                plant=robot.plant,
                faults=robot.faults,
                controller=controller,
                observe=meter.observe,
            )
    except (AdpError, np.linalg.LinAlgError) as error:
        return {**nothing, **_constant(count, {"problem": str(error)})}
    lost = found.failed | ~np.isfinite(found.cost)
    columns = {
        "cost": found.cost,
        "effort": found.effort,
        **meter.columns(),
        "settling_time": found.settling_time,
    }
    seen = {name: np.where(lost, nothing[name], values) for name, values in columns.items()}
    return {**seen, "excitation": found.excitation, **_constant(count, {"problem": ""})}


@functools.lru_cache(maxsize=16)
def _path(source: PathSource, settings: PathSettings) -> Path:
    return source.path(settings)
