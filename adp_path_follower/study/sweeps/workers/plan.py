"""The parts in which a sweep is worked off: what one worker does at once, and one file holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.study.sweeps.request.request import Sweep
from adp_path_follower.study.sweeps.workers.optima import optimal_costs
from adp_path_follower.study.sweeps.workers.runs import MOST_AT_ONCE, Batch, Columns, simulate_batch


@dataclass(frozen=True)
class Part:
    """Consecutive runs of a sweep.

    Attributes:
        number: From 0.
        batches: Runs that are simulated, one after the other.
        columns: Values that the runs share or vary: column name -> values, (N,).

    """

    number: int
    batches: tuple[Batch, ...]
    columns: Columns


class Plan:
    """Divides a sweep into parts, which depend on nothing but the sweep."""

    def __init__(self, sweep: Sweep) -> None:
        """Take the sweep."""
        self.sweep = sweep
        self._blocks_each = -(-sweep.runs_each // MOST_AT_ONCE)
        self._block = -(-sweep.runs_each // self._blocks_each)
        # Many small groups make one part, so that there are few files; a large one makes several.
        self._groups = max(1, MOST_AT_ONCE // sweep.runs_each)

    @property
    def parts(self) -> int:
        """Return the number of parts."""
        groups = self.sweep.combinations * self.sweep.groups_each
        if self._blocks_each > 1:
            return groups * self._blocks_each
        return -(-groups // self._groups)

    def runs_of(self, number: int) -> range:
        """Return the numbers of the runs of a part."""
        sweep = self.sweep
        if self._blocks_each > 1:
            group, block = divmod(number, self._blocks_each)
            first = group * sweep.runs_each
            start = first + block * self._block
            return range(start, min(start + self._block, first + sweep.runs_each))
        size = self._groups * sweep.runs_each
        return range(number * size, min((number + 1) * size, sweep.runs))

    def part(self, number: int) -> Part:
        """Return a part."""
        runs = self.runs_of(number)
        batches: list[Batch] = []
        columns: list[Columns] = []
        for group, inside in self._groups_in(runs):
            for batch, shared in self._batches(group, inside):
                batches.append(batch)
                columns.append(shared)
        joined = {name: np.concatenate([item[name] for item in columns]) for name in columns[0]}
        return Part(number, tuple(batches), joined)

    def _groups_in(self, runs: range) -> Iterator[tuple[int, range]]:
        """Return each group of the runs, and which of its runs: numbers within the group."""
        size = self.sweep.runs_each
        for group in range(runs.start // size, -(-runs.stop // size)):
            first = group * size
            yield group, range(max(runs.start, first) - first, min(runs.stop - first, size))

    def _batches(self, group: int, inside: range) -> Iterator[tuple[Batch, Columns]]:
        """Return the batches of a group: one for each stretch of consecutive seeds."""
        sweep, conditions = self.sweep, self.sweep.conditions
        combination, place = divmod(group, sweep.groups_each)
        path_number, robot_number = divmod(place, len(conditions.robots))
        source, robot = conditions.paths[path_number], conditions.robots[robot_number]
        settings = sweep.settings(combination)
        optimal = optimal_costs(conditions, settings, source)
        numbers = np.asarray(inside)
        start = numbers % len(conditions.starts)
        seed = np.asarray(conditions.noise_seeds)[numbers // len(conditions.starts)]
        robot_seed = seed * len(conditions.starts) + start
        for some in np.split(np.arange(len(numbers)), np.flatnonzero(np.diff(robot_seed) != 1) + 1):
            batch = Batch(
                first_run=group * sweep.runs_each + int(numbers[some[0]]),
                settings=settings,
                cost=conditions.settings.cost,
                source=source,
                robot=robot,
                starts=conditions.starts[start[some]],
                optimal_cost=optimal[start[some]],
                first_seed=int(robot_seed[some[0]]),
                run=conditions.run,
            )
            shared = {
                "combination": np.full(len(some), combination),
                **_setting_columns(sweep, combination, len(some)),
                "path": np.full(len(some), source.name, dtype=object),
                "robot": np.full(len(some), robot.name, dtype=object),
                "noise_seed": seed[some],
                "start": start[some],
            }
            yield batch, shared


def work_off(part: Part) -> Columns:
    """Return the table of a part: column name -> values, one for each run in order."""
    measured = [simulate_batch(batch) for batch in part.batches]
    columns = {name: np.concatenate([item[name] for item in measured]) for name in measured[0]}
    return {"run": columns.pop("run"), **part.columns, **columns}


def check_first_runs(sweep: Sweep) -> None:
    """Refuse what no run could be made with, before the long work: each path is tried once.

    Raises:
        AdpError: The controller cannot be made with the settings for a path.

    """
    from adp_path_follower.core.driving.follower import PathFollower

    for source in sweep.conditions.paths:
        settings: Settings = sweep.settings(0)
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
