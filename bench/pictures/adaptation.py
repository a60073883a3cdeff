"""Measure how fast the learner adapts: draw docs/images/adaptation.png, print the losses.

A change of a setting, or of the path, makes the learner begin again from the Riccati solution. Here
it learns for a while after the change; then robots start, twelve of them off the path by up to 1 m
and 60 degrees, and learning goes on. Their loss J/J* - 1 tells how good the policy was. It takes
about five minutes: python bench/pictures/adaptation.py [FILE.png]
"""

from __future__ import annotations

import sys
from pathlib import Path as FilePath

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import adp_path_follower
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.files import read_csv_columns
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.bellman import BellmanErrors, Observation
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.drawing.figure_style import COLORS, STYLE
from adp_path_follower.study.optimum.collocation import OptimumSolver
from adp_path_follower.study.simulation.simulate import simulate

_PERIOD = 0.01  # [s]
_DELAYS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)  # [s] from the change to the start
_DURATION = 20.0  # [s] of J
_PLACE = 15.5  # [m] along the figure eight: 1.5 m before its sharpest bend
_CHANGES: dict[str, tuple[str, dict[str, object]]] = {
    "desired_speed 0.5 → 0.9 m/s": ("lissajous", {"desired_speed": 0.9}),
    "state_cost of y 1 → 3": ("lissajous", {"state_cost": [1.0, 3.0, 1.0]}),
    "input_cost 1 → 3": ("lissajous", {"input_cost": [3.0, 3.0]}),
    "target_gain 0.1 → 0.5 1/s": ("lissajous", {"target_gain": 0.5}),
    "max_angular_vel 1.5 → 1 rad/s": ("lissajous", {"max_angular_vel": 1.0}),
    "another path: circle of 1 m": ("circle:1.0", {}),
}
_NO_ERRORS = BellmanErrors(np.zeros(1), np.zeros((1, 1)), np.ones(1))


def main() -> None:
    """Measure every change, and draw."""
    file = FilePath(sys.argv[1] if len(sys.argv) > 1 else "docs/images/adaptation.png")
    data = FilePath(adp_path_follower.__file__).parent / "data" / "forty_starts.csv"
    starts = np.asarray(read_csv_columns(data, ("s", "y", "theta")))[:12]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.0, 4.2))
        axes = figure.subplots()
        for color, (name, (path_name, values)) in zip(COLORS, _CHANGES.items(), strict=False):
            losses = _losses(build(Settings, values), named_path(path_name), starts)
            shown = ", ".join(f"{loss:.2%}" for loss in losses)
            print(f"{name:32} {shown}", flush=True)
            axes.semilogy(np.maximum(_DELAYS, 0.01), losses, "-o", color=color, label=name)
        axes.set_xscale("log")
        axes.set_xticks([0.01, 0.1, 1.0], ["0", "0.1", "1"])
        axes.set_xlabel("time of learning after the change, before the start [s]")
        axes.set_ylabel("loss J/J* − 1, mean of 12 starts")
        axes.set_title("After a change the policy is\nnear-optimal again within a second")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15))
        figure.savefig(file, bbox_inches="tight")


def _losses(settings: Settings, path: Path, starts: FloatArray) -> list[float]:
    """Return the mean loss after each delay."""
    place = 0.0 if path.length < _PLACE else _PLACE
    solver = OptimumSolver(settings, path, place, _DURATION)
    optimal = np.array([solver.solve(start).cost for start in starts])

    def loss(delay: float) -> float:
        def learned(settings: Settings, path: Path, arc_length: FloatArray) -> PathFollower:
            follower = PathFollower(settings, path, arc_length)
            for _ in range(round(delay / _PERIOD)):
                follower._learner.learn(Observation(arc_length, lambda: _NO_ERRORS), _PERIOD)
            return follower

        result = simulate(
            settings,
            path,
            starts,
            start_arc_length=place,
            duration=_DURATION,
            rate=1.0 / _PERIOD,
            controller=learned,
        )
        return float(np.mean(result.cost / optimal) - 1.0)

    return [loss(delay) for delay in _DELAYS]


if __name__ == "__main__":
    main()
