"""Measure one control tick against a single small linear solve, in one run.

    python bench/tick.py [--json FILE]

Absolute times depend on the machine and on what else it does; the ratio to `numpy.linalg.solve`
on a 9 x 9 matrix, measured in turns with everything else, hardly does. Ticks are those of a robot
that drives along the paper's figure eight.
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
from adp_path_follower.core.geometry import FloatArray, advance_pose
from adp_path_follower.core.knot_model import KnotModel, fit
from adp_path_follower.core.learner import update_weights
from adp_path_follower.core.parameter_file import load_settings
from adp_path_follower.core.path_library import lissajous
from adp_path_follower.core.settings import Settings
from adp_path_follower.shared_files import config_file

ROUNDS, CALLS = 30, 200
_PERIOD = 0.01  # [s]
_POSE = np.array([0.3, 0.5, 0.4])
_TICKS = 20_000  # of which the slowest of a hundred is shown


class Drive:
    """A robot that does what its controller says."""

    def __init__(self, file: Path | None = None, *assignments: str) -> None:
        """Take the settings of a parameter file, with some changed."""
        settings = load_settings(Settings, "path_follower", file, assignments=assignments)
        self.follower = PathFollower(settings, lissajous())
        self._pose: FloatArray = _POSE

    def tick(self) -> float:
        """Drive on for one period; return how long the controller took [s]."""
        start = time.perf_counter()
        output = self.follower.step(self._pose, _PERIOD)
        elapsed = time.perf_counter() - start
        self._pose = advance_pose(self._pose, *output.command, _PERIOD)
        return elapsed


def parts() -> dict[str, Callable[[], object]]:
    """Return what a tick consists of, by name."""
    paper, default = Drive(config_file("paper.yaml")).follower, Drive().follower
    output, weights, settings = paper.step(_POSE, _PERIOD), paper.weights, paper.settings
    model = SampledModel(settings, paper.path)
    knots, ahead = KnotModel(default.settings, 0.2), default.weights.critic
    step = default.settings.learning.samples_per_step
    equations = knots.equations(slice(None), ahead, 0.1)
    rng = np.random.default_rng(0)
    matrix, vector = np.eye(9) + 0.1 * rng.standard_normal((9, 9)), rng.standard_normal(9)
    return {
        "numpy.linalg.solve, 9 x 9": lambda: np.linalg.solve(matrix, vector),
        "path frame": lambda: paper.path.frame(3.0),
        "paper: Bellman sweep, 81 samples, 9 weights": lambda: model.sweep(
            weights.critic, weights.actor
        ),
        "paper: weight update": lambda: update_weights(
            weights, output.measured, output.sampled, settings.learning, _PERIOD
        ),
        "paper: certificate": lambda: excitation(output.sampled.information),
        f"default: Bellman errors, {step} samples": lambda: knots.equations(
            slice(0, step), ahead, 0.1
        ),
        "default: solve for a knot, 80 weights": lambda: fit(equations),
    }


def medians_in_turns(drives: dict[str, Drive]) -> dict[str, float]:
    """Return the median time [µs] of every part and tick; a slow moment hits all alike."""
    cases = parts()
    times: dict[str, list[float]] = {name: [] for name in (*cases, *drives)}
    for _ in range(ROUNDS):
        for name, call in cases.items():
            start = time.perf_counter()
            for _ in range(CALLS):
                call()
            times[name].append(1e6 * (time.perf_counter() - start) / CALLS)
        for name, drive in drives.items():
            times[name] += [1e6 * drive.tick() for _ in range(CALLS)]
    return {name: float(np.median(found)) for name, found in times.items()}


def main() -> None:
    """Print the table, and write it if asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the times [µs] and ratios here")
    arguments = parser.parse_args()
    medians = medians_in_turns(
        {
            "paper: control tick": Drive(config_file("paper.yaml")),
            "default: control tick, not learning": Drive(None, "learning=false"),
            "default: control tick": Drive(),
        }
    )
    floor = medians["numpy.linalg.solve, 9 x 9"]
    print(f"{platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}")
    for name, median in medians.items():
        print(f"{name:<44}{median:9.1f} µs   {median / floor:7.1f} x solve")
    drive = Drive()
    ticks = [1e6 * drive.tick() for _ in range(_TICKS)]
    middle, slow, slowest = np.quantile(ticks, [0.5, 0.99, 1.0])
    print(
        f"default: of {_TICKS} ticks one after the other, half within {middle:.0f} µs, "
        f"99 % within {slow:.0f} µs, the slowest {slowest:.0f} µs"
    )
    if arguments.json:
        rows = {name: {"us": value, "ratio": value / floor} for name, value in medians.items()}
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
