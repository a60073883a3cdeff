"""Divides a sweep into parts: the work of one worker at a time, and the content of one file."""

import time
from dataclasses import dataclass, replace

import numpy as np

from adp_path_follower.core.errors import AdpError
from adp_path_follower.study.sweeps.request.conditions import optimal_costs
from adp_path_follower.study.sweeps.request.request import Sweep
from adp_path_follower.study.sweeps.workers.cluster import workers
from adp_path_follower.study.sweeps.workers.runs import (
    MOST_AT_ONCE,
    Batch,
    Columns,
    joined,
    simulate_batch,
)

_TIMED_PARTS = 3
_SHORT, _LONG = 0.3, 0.9  # [s] of simulated time


@dataclass(frozen=True)
class Part:
    """Consecutive runs of a sweep."""

    number: int  # from 0
    batches: tuple[Batch, ...]  # runs that are simulated, one after the other
    columns: Columns  # values that the runs share or vary: column name -> values, (N,)


class Plan:
    """Divides a sweep into parts, which depend on nothing but the sweep."""

    def __init__(self, sweep: Sweep) -> None:
        """Take the sweep."""
        self.sweep = sweep
        # Many small groups make one part, so that there are few files; a large one makes several.
        self._size = MOST_AT_ONCE // sweep.runs_each * sweep.runs_each or MOST_AT_ONCE

    @property
    def parts(self) -> int:
        """Return the number of parts."""
        return -(-self.sweep.runs // self._size)

    def runs_of(self, number: int) -> range:
        """Return the numbers of the runs of a part."""
        first = number * self._size
        return range(first, min(first + self._size, self.sweep.runs))

    def part(self, number: int) -> Part:
        """Return a part: a batch for each stretch of consecutive seeds in a group."""
        runs = np.asarray(self.runs_of(number))
        _, _, robot_seed = self._seeds(runs)
        ends = (np.diff(robot_seed) != 1) | (np.diff(runs // self.sweep.runs_each) != 0)
        pieces = [self._batch(some) for some in np.split(runs, np.flatnonzero(ends) + 1)]
        columns = joined([shared for _, shared in pieces])
        return Part(number, tuple(batch for batch, _ in pieces), columns)

    def _seeds(self, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the numbers of start, noise sequence and robot's seed of runs (N,), (N,) each."""
        conditions = self.sweep.conditions
        noise, start = np.divmod(runs % self.sweep.runs_each, len(conditions.starts))
        seed = np.asarray(conditions.noise_seeds)[noise]
        return start, seed, seed * len(conditions.starts) + start

    def _batch(self, runs: np.ndarray) -> tuple[Batch, Columns]:
        """Return the batch of some runs (N,) of one group, and the columns known before."""
        sweep, conditions = self.sweep, self.sweep.conditions
        combination, place = divmod(int(runs[0]) // sweep.runs_each, sweep.groups_each)
        path_number, robot_number = divmod(place, len(conditions.robots))
        source, robot = conditions.paths[path_number], conditions.robots[robot_number]
        settings = sweep.settings(combination)
        start, seed, robot_seed = self._seeds(runs)
        batch = Batch(
            first_run=int(runs[0]),
            settings=settings,
            cost=conditions.settings.cost,
            source=source,
            robot=robot,
            starts=conditions.starts[start],
            optimal_cost=optimal_costs(conditions, settings, source)[start],
            first_seed=int(robot_seed[0]),
            run=conditions.run,
        )
        shared = {
            "combination": np.full(len(runs), combination),
            **_setting_columns(sweep, combination, len(runs)),
            "path": np.full(len(runs), source.name, dtype=object),
            "robot": np.full(len(runs), robot.name, dtype=object),
            "noise_seed": seed,
            "start": start,
        }
        return batch, shared


def work_off(part: Part) -> Columns:
    """Return the table of a part: column name -> values, one for each run in order."""
    columns = joined([simulate_batch(batch) for batch in part.batches])
    return {"run": columns.pop("run"), **part.columns, **columns}


def check_first_runs(sweep: Sweep) -> None:
    """Raise AdpError before the long work if the controller cannot follow one of the paths."""
    from adp_path_follower.core.driving.follower import PathFollower

    settings = sweep.settings(0)
    for source in sweep.conditions.paths:
        try:
            PathFollower(settings, source.path(settings.path), np.zeros(1))
        except AdpError as error:
            raise AdpError(f"path '{source.name}' cannot be followed: {error}") from None


def _setting_columns(sweep: Sweep, combination: int, count: int) -> Columns:
    """Return a column for each thing that varies; lists as texts."""
    columns: Columns = {}
    for name, value in sweep.varied(combination).items():
        if isinstance(value, tuple | str):
            columns[name] = np.full(count, str(value), dtype=object)
        else:
            columns[name] = np.full(count, value)
    return columns


@dataclass(frozen=True)
class Estimate:
    """Expected computing time of a sweep."""

    workers: int  # number of parts that run at once
    seconds: float  # computing time on all workers [s]
    seconds_each: float  # computing time of a run on one worker [s]


def estimate(sweep: Sweep, address: str | None, count: int | None) -> Estimate:
    """Return a sweep's computing time by a few batches here; AdpError without the scheduler."""
    plan = Plan(sweep)
    numbers = np.unique(np.linspace(0, plan.parts - 1, _TIMED_PARTS).astype(int))
    batches = [plan.part(int(number)).batches[0] for number in numbers]
    _timed(batches[0], _SHORT)  # fills caches
    # Making the controller costs time once, control steps cost time again and again.
    shorts, longs = (
        np.array([_timed(batch, duration) for batch in batches]) for duration in (_SHORT, _LONG)
    )
    rate = np.maximum(0.0, longs - shorts) / (_LONG - _SHORT)
    seconds = shorts + rate * max(0.0, sweep.conditions.run.duration - _SHORT)
    each = float(np.mean(seconds) / np.mean([len(batch) for batch in batches]))
    with workers(address, count) as found:
        at_once = found.count
    return Estimate(at_once, each * sweep.runs / min(at_once, plan.parts), each)


def in_words(seconds: float) -> str:
    """Return a time in seconds, minutes or hours."""
    if seconds < 90.0:
        return f"{max(1.0, seconds):.0f} s"
    if seconds < 5400.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"


def _timed(batch: Batch, duration: float) -> float:
    """Return the computing time [s] of a batch over a simulated duration [s]."""
    begun = time.perf_counter()
    simulate_batch(replace(batch, run=replace(batch.run, duration=duration)))
    return time.perf_counter() - begun
