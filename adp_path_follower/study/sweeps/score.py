"""The score of settings: numbers over all runs with them."""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.study.sweeps.request.objectives import (
    OBJECTIVES,
    Columns,
    cost_column,
    unstable_runs,
)
from adp_path_follower.study.sweeps.request.request import Sweep
from adp_path_follower.study.sweeps.workers.plan import Plan, work_off

UNSTABLE_SCORE = 1e9  # stands for no number: a run is lost, or never settles


@dataclass(frozen=True)
class Score:
    """Numbers over all runs with the same settings."""

    objectives: dict[str, float]  # all objectives: name -> value
    runs: int  # number of runs
    unstable: int  # number of runs that are not stable
    relative: bool  # whether costs are J/J*; J otherwise
    median: float  # median of the costs
    high: float  # 95 % quantile of the costs
    largest: float  # greatest cost
    problem: str  # why runs were impossible, empty if all were possible


def score_runs(sweep: Sweep) -> Score:
    """Simulate the runs of a sweep of one combination, on a worker."""
    plan = Plan(sweep)
    parts = [work_off(plan.part(number)) for number in range(plan.parts)]
    return score_of_runs(
        {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    )


def score_of_runs(columns: Columns) -> Score:
    """Return the score of runs: column name -> values, shape (N,)."""
    cost = cost_column(columns)
    cost = np.where(np.isfinite(cost), cost, math.inf)
    median, high = np.quantile(cost, [0.5, 0.95], method="higher")
    return Score(
        {name: _number(objective.of(columns)) for name, objective in OBJECTIVES.items()},
        runs=len(cost),
        unstable=unstable_runs(columns),
        relative=bool(np.isfinite(columns["optimal_cost"]).all()),
        median=_number(median),
        high=_number(high),
        largest=_number(cost.max()),
        problem=next((str(text) for text in columns["problem"] if text), ""),
    )


def _number(value: float) -> float:
    return float(value) if math.isfinite(value) else UNSTABLE_SCORE
