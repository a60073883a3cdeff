"""Measures of good settings: numbers over all runs with them."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

UNSTABLE_SCORE = 1e9  # stands for no number: a run is lost, or never settles

Columns = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Objective:
    """A number that is to be small."""

    meaning: str  # in words
    unit: str  # unit of the number
    of: Callable[[Columns], float]  # returns it from the columns of all runs with the same settings


def cost_column(columns: Columns) -> np.ndarray:
    """Return J/J* of each run if it is known of all, J otherwise."""
    known = np.isfinite(columns["optimal_cost"]).all()
    return np.asarray(columns["cost_ratio" if known else "cost"], dtype=float)


OBJECTIVES = {  # by the names that files give them
    "cost": Objective(
        "mean J/J* of the runs, or mean J where J* is not known of all",
        "",
        lambda columns: float(np.mean(cost_column(columns))),
    ),
    "worst_case": Objective(
        "greatest J/J* (or J) of any run: over starts, paths, robots and noise",
        "",
        lambda columns: float(np.max(cost_column(columns))),
    ),
    "effort": Objective(
        "mean ∫ uᵀRu of the runs",
        "",
        lambda columns: float(np.mean(columns["effort"])),
    ),
    "cross_track": Objective(
        "RMS distance from the path after the transient, over all runs",
        "m",
        lambda columns: math.sqrt(float(np.mean(columns["cross_track_rms"] ** 2))),
    ),
    "worst_cross_track": Objective(
        "greatest distance from the path after the transient, of any run",
        "m",
        lambda columns: float(np.max(columns["cross_track_max"])),
    ),
    "settling_time": Objective(
        "longest settling time of any run",
        "s",
        lambda columns: float(np.max(columns["settling_time"])),
    ),
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
    cost = cost_column(columns)
    median, high = np.quantile(
        np.where(np.isfinite(cost), cost, math.inf), [0.5, 0.95], method="higher"
    )
    return Score(
        {name: _number(objective.of(columns)) for name, objective in OBJECTIVES.items()},
        runs=len(cost),
        unstable=int((~columns["stable"].astype(bool)).sum()),
        relative=bool(np.isfinite(columns["optimal_cost"]).all()),
        median=_number(median),
        high=_number(high),
        problem=next((str(text) for text in columns["problem"] if text), ""),
    )


def _number(value: float) -> float:
    return float(value) if math.isfinite(value) else UNSTABLE_SCORE
