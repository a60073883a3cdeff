"""Overview of a sweep: scores of each combination of settings, and the best one."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower.core.files import write_output
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import parameter_file_text
from adp_path_follower.core.settings.schema import Value
from adp_path_follower.study.sweeps.request.objectives import (
    OBJECTIVES,
    Columns,
    Score,
    pareto_front,
    score_of_runs,
    unstable_runs,
)
from adp_path_follower.study.sweeps.request.request import Sweep


@dataclass(frozen=True)
class Overview:
    """A sweep in numbers; the rows of the arrays are the C combinations of settings."""

    sweep: Sweep  # the sweep
    # All objectives: name -> values, shape (C,); NaN where a run is lost.
    scores: Mapping[str, FloatArray]
    unstable: np.ndarray  # number of runs that are not stable, shape (C,)
    problems: Mapping[str, int]  # sentence -> number of runs that it made impossible
    best: int | None  # stable combination with the least first objective; None if all are unstable
    # Path, robot and score of the best settings on each path with each robot.
    cases: tuple[tuple[str, str, Score], ...]
    relative: bool  # whether costs are J/J*; J otherwise

    @property
    def ranked(self) -> np.ndarray:
        """Return the stable combinations, the best first, by the first objective."""
        score = np.where(self.unstable == 0, self.scores[self.sweep.objectives[0]], math.nan)
        order = np.argsort(score, kind="stable")
        return np.asarray(order[np.isfinite(score[order])])

    @property
    def front(self) -> np.ndarray:
        """Return the stable combinations on the Pareto front of the first two objectives."""
        names = self.sweep.objectives[:2]
        if len(names) < 2:
            return self.ranked[:1]
        points = np.column_stack([self.scores[name] for name in names])
        points[self.unstable > 0] = math.nan
        found = np.flatnonzero(pareto_front(points))
        return np.asarray(found[np.argsort(points[found, 0])])

    @property
    def shares_unstable(self) -> FloatArray:
        """Return the share of unstable runs of each combination, shape (C,)."""
        return np.asarray(self.unstable * (self.sweep.combinations / self.sweep.runs))


def overview(sweep: Sweep, groups: Iterable[Columns]) -> Overview:
    """Return the overview of a sweep from its runs, one combination after the other."""
    count = sweep.combinations
    scores = {name: np.full(count, math.nan) for name in OBJECTIVES}
    unstable = np.zeros(count, dtype=int)
    problems: dict[str, int] = {}
    best, least = None, math.inf
    cases: tuple[tuple[str, str, Score], ...] = ()
    relative = True
    for columns in groups:
        number = int(columns["combination"][0])
        unstable[number] = unstable_runs(columns)
        relative &= bool(np.isfinite(columns["optimal_cost"]).all())
        for problem in filter(None, columns["problem"]):
            problems[str(problem)] = problems.get(str(problem), 0) + 1
        for name, objective in OBJECTIVES.items():
            scores[name][number] = objective.of(columns)
        score = scores[sweep.objectives[0]][number]
        if not unstable[number] and score < least:
            best, least, cases = number, score, tuple(_cases(sweep, columns))
    return Overview(sweep, scores, unstable, problems, best, cases, relative)


def _cases(sweep: Sweep, columns: Columns) -> Iterable[tuple[str, str, Score]]:
    if not np.isfinite(columns["optimal_cost"]).all():  # then no case shows J/J*
        columns = {**columns, "optimal_cost": np.full(len(columns["cost"]), math.nan)}
    for source in sweep.conditions.paths:
        for robot in sweep.conditions.robots:
            some = (columns["path"] == source.name) & (columns["robot"] == robot.name)
            score = score_of_runs({name: values[some] for name, values in columns.items()})
            yield source.name, robot.name, score


def shown(value: Value) -> str:
    """Return a value in few digits."""
    if isinstance(value, tuple):
        return "[" + ", ".join(shown(item) for item in value) + "]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def write_settings(
    file: FilePath, settings: Settings, comment: str, values: Mapping[str, Value]
) -> None:
    """Write a parameter file with a comment and the varied values; may raise FileError."""
    varied = ", ".join(f"{name}: {shown(value)}" for name, value in values.items())
    text = parameter_file_text(settings, "path_follower")
    write_output(file, f"# {comment}\n# Varied: {varied or 'nothing'}.\n{text}")


def summary_text(found: Overview, rows: int = 10) -> str:
    """Return the best settings as a table, with remarks."""
    sweep = found.sweep
    names = [item.name for item in sweep.variations]
    head = [*names, *(_title(name, found.relative) for name in sweep.objectives)]
    table = [head]
    for number in found.ranked[:rows]:
        values = sweep.varied(int(number))
        table.append(
            [shown(values[name]) for name in names]
            + [f"{found.scores[name][number]:.4f}" for name in sweep.objectives]
        )
    widths = [max(len(row[column]) for row in table) for column in range(len(head))]
    lines = [
        "  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True))
        for row in table
    ]
    bad = int((found.unstable > 0).sum())
    if found.best is None:
        lines = ["no combination of settings is stable in all its runs"]
    elif len(found.ranked) > rows:
        lines.append(f"… and {len(found.ranked) - rows:,} more")
    if bad:
        lines.append(
            f"{bad:,} of {sweep.combinations:,} combinations are unstable in some run "
            f"({int(found.unstable.sum()):,} of {sweep.runs:,} runs)"
        )
    lines += [f"{count:,} runs could not be made: {text}" for text, count in found.problems.items()]
    return "\n".join(lines)


def _title(name: str, relative: bool) -> str:
    return f"{name} (J/J*)" if relative and name in ("cost", "worst_case") else name
