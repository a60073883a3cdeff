"""One trial of a tuning: all runs with the same settings, and what they say of them."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from adp_path_follower.study.sweeps.request.objectives import OBJECTIVES, cost_column, unstable_runs
from adp_path_follower.study.sweeps.request.sweep_file import Sweep
from adp_path_follower.study.sweeps.workers.plan import Plan, work_off

UNSTABLE_SCORE = 1e9  # of an objective that has no number: a run is lost, or never settles


@dataclass(frozen=True)
class Score:
    """What the runs with the same settings say of them.

    Attributes:
        objectives: Name -> value, of all objectives that there are.
        runs: Their number.
        unstable: How many of them are not stable.
        relative: Whether costs are J/J*; J otherwise.
        median: Of the costs.
        high: 95 % quantile.
        largest: Greatest.
        problem: Why runs could not be made, empty where they could.

    """

    objectives: dict[str, float]
    runs: int
    unstable: int
    relative: bool
    median: float
    high: float
    largest: float
    problem: str

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        return asdict(self)


def score_runs(sweep: Sweep) -> Score:
    """Simulate the runs of a sweep of one combination; this is what a worker does."""
    plan = Plan(sweep)
    parts = [work_off(plan.part(number)) for number in range(plan.parts)]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    cost = cost_column(columns)
    cost = np.where(np.isfinite(cost), cost, math.inf)
    median, high = np.quantile(cost, [0.5, 0.95], method="higher")
    found = {name: objective.of(columns) for name, objective in OBJECTIVES.items()}
    return Score(
        objectives={
            name: value if math.isfinite(value) else UNSTABLE_SCORE for name, value in found.items()
        },
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
