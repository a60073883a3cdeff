"""Measure one control tick against a single small linear solve, in one run.

    python bench/tick.py [--json FILE]

Absolute times depend on the machine and on what else it does; the ratio to `numpy.linalg.solve`
on a 9 x 9 matrix, measured in turns with everything else, hardly does.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from adp_path_follower.core.bellman import SampledModel, excitation
from adp_path_follower.core.follower import PathFollower
from adp_path_follower.core.knot_model import KnotModel, fit
from adp_path_follower.core.learner import update_weights
from adp_path_follower.core.parameter_file import load_settings
from adp_path_follower.core.path_library import lissajous
from adp_path_follower.core.settings import Settings
from adp_path_follower.shared_files import config_file

ROUNDS, CALLS = 30, 200
_TICKS = 20_000  # of which the slowest of a hundred is shown
_FROZEN = ("learning=false",)


def main() -> None:
    """Print the table, and write it if asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the times [µs] and ratios here")
    arguments = parser.parse_args()
    settings = load_settings(Settings, "path_follower", config_file("paper.yaml"))
    default = PathFollower(load_settings(Settings, "path_follower"), lissajous())
    frozen = PathFollower(
        load_settings(Settings, "path_follower", assignments=_FROZEN), lissajous()
    )
    knots = KnotModel(default.settings, 0.2)
    ahead = default.weights.critic
    equations = knots.equations(slice(None), ahead, 0.1)
    follower = PathFollower(settings, lissajous())
    pose = np.array([-0.4, -0.3, 0.7])
    output = follower.step(pose, 0.01)
    weights, model = follower.weights, SampledModel(settings, follower.path)
    rng = np.random.default_rng(0)
    matrix, vector = np.eye(9) + 0.1 * rng.standard_normal((9, 9)), rng.standard_normal(9)
    cases: dict[str, Callable[[], object]] = {
        "numpy.linalg.solve, 9 x 9": lambda: np.linalg.solve(matrix, vector),
        "paper: Bellman sweep, 81 samples, 9 weights": lambda: model.sweep(
            weights.critic, weights.actor
        ),
        "paper: weight update": lambda: update_weights(
            weights, output.measured, output.sampled, settings.learning, 0.01
        ),
        "paper: certificate": lambda: excitation(output.sampled.information),
        "path frame": lambda: follower.path.frame(3.0),
        "paper: control tick": lambda: follower.step(pose, 0.01),
        "default: Bellman errors, 192 samples": lambda: knots.equations(
            slice(0, 192), ahead, 0.1, 0.2
        ),
        "default: solve for a knot, 80 weights": lambda: fit(equations),
        "default: control tick, not learning": lambda: frozen.step(pose, 0.01),
        "default: control tick": lambda: default.step(pose, 0.01),
    }
    times: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(ROUNDS):  # in turns, so that a slow moment of the machine hits all alike
        for name, call in cases.items():
            start = time.perf_counter()
            for _ in range(CALLS):
                call()
            times[name].append(1e6 * (time.perf_counter() - start) / CALLS)
    medians = {name: float(np.median(found)) for name, found in times.items()}
    floor = medians["numpy.linalg.solve, 9 x 9"]
    print(f"{platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}")
    for name, median in medians.items():
        print(f"{name:<42}{median:9.1f} µs   {median / floor:7.1f} x solve")
    ticks = []
    for _ in range(_TICKS):
        start = time.perf_counter()
        default.step(pose, 0.01)
        ticks.append(1e6 * (time.perf_counter() - start))
    slow, slowest = np.quantile(ticks, 0.99), max(ticks)
    print(f"default: of {_TICKS} ticks, 99 % within {slow:.0f} µs, the slowest {slowest:.0f} µs")
    if arguments.json:
        rows = {name: {"us": value, "ratio": value / floor} for name, value in medians.items()}
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
