"""Measures of good settings: numbers over all runs with them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray

UNSTABLE_SCORE = 1e9  # stands for no number: a run is lost, or never settles

Columns = Mapping[str, np.ndarray]


def _rms(values: FloatArray) -> float:
    return math.sqrt(float(np.mean(values**2)))


@dataclass(frozen=True)
class Objective:
    """A number that is to be small."""

    meaning: str  # in words, where J* is known of all runs
    unit: str  # unit of the number
    column: str  # of all runs with the same settings; "cost" is J/J*, or J if J* is not known
    reduce: Callable[[FloatArray], float]  # makes one number of the column


OBJECTIVES = {  # by the names that files give them
    "cost": Objective("mean J/J* of the runs", "", "cost", np.mean),
    "worst_case": Objective(
        "greatest J/J* of any run: over starts, paths, robots and noise", "", "cost", np.max
    ),
    "effort": Objective("mean ∫ uᵀRu of the runs", "", "effort", np.mean),
    "cross_track": Objective(
        "RMS distance from the path after the transient, over all runs",
        "m",
        "cross_track_rms",
        _rms,
    ),
    "worst_cross_track": Objective(
        "greatest distance from the path after the transient, of any run",
        "m",
        "cross_track_max",
        np.max,
    ),
    "settling_time": Objective("longest settling time of any run", "s", "settling_time", np.max),
}


@dataclass(frozen=True)
class Score:
    """Numbers over all runs with the same settings."""

    objectives: dict[str, float]  # all objectives: name -> value
    runs: int  # number of runs
    unstable: int  # number of runs that are not stable
    relative: bool  # whether costs are J/J*; J otherwise
    median: float  # median of the costs
    high: float  # 95 % quantile of the costs
    problem: str  # why runs were impossible, empty if all were possible


def score_of_runs(columns: Columns) -> Score:
    """Return the score of runs: column name -> values, shape (N,)."""
    relative = bool(np.isfinite(columns["optimal_cost"]).all())
    cost = np.asarray(columns["cost_ratio" if relative else "cost"], dtype=float)
    judged = {**columns, "cost": cost}
    median, high = np.quantile(
        np.where(np.isfinite(cost), cost, math.inf), [0.5, 0.95], method="higher"
    )
    return Score(
        {name: _number(item.reduce(judged[item.column])) for name, item in OBJECTIVES.items()},
        runs=len(cost),
        unstable=int((~columns["stable"].astype(bool)).sum()),
        relative=relative,
        median=_number(median),
        high=_number(high),
        problem=next((str(text) for text in columns["problem"] if text), ""),
    )


def _number(value: float) -> float:
    return float(value) if math.isfinite(value) else UNSTABLE_SCORE
