"""Compare all 160 reference optima: `python bench/endurance/optima.py`, about two minutes.

The reference in test/data was computed elsewhere; the tests solve every fifth of its starts.
"""

from __future__ import annotations

import json
import math
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.optimum.collocation import OptimumSolver

_DATA = FilePath(__file__).resolve().parents[2] / "test" / "data" / "optimum.json"
_PATHS = {
    "lissajous": "lissajous",
    "line": "line",
    "circle0.5": "circle:0.5",
    "circle1.0": "circle:1.0",
}
_UNLIMITED = {
    "min_linear_vel": -math.inf,
    "max_linear_vel": math.inf,
    "max_angular_vel": math.inf,
}


def main() -> int:
    """Print the largest differences of each path; fail if one of them is above the tests'."""
    reference = json.loads(_DATA.read_text())["forty_starts"]
    failed = False
    for key, name in _PATHS.items():
        solver = OptimumSolver(build(Settings, _UNLIMITED), named_path(name), horizon=30.0)
        found = [solver.solve(np.array(start)) for start in reference["e0"]]
        costs = np.array([item.cost for item in found])
        apart = float(np.abs(costs / reference[key]["costs"] - 1.0).max())
        change = max(item.horizon_change for item in found)
        several = sum(bool(item.local_optima) for item in found)
        print(
            f"{name:>10}: J* within {apart:.1e} of the reference, within {change:.1e} of that of a "
            f"longer horizon; {several} starts with several optima"
        )
        failed |= apart > 1e-5 or change > 1e-6 or several > 0
    return int(failed)


if __name__ == "__main__":
    raise SystemExit(main())
