"""Measure control ticks against floors in the same run: what they consist of, and the slowest.

    python bench/speed/tick.py [--ticks 100000] [--json FILE]

Absolute times depend on the machine and its other work; ratios measured in turns hardly do. The
robot drives along the paper's figure eight. Between each two ticks of the long run, a loop of plain
Python takes about the same time: the spread of its turns is the machine's, not the controller's.
"""

from __future__ import annotations

import gc
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path as FilePath

import numpy as np
from timing import Row, arguments, in_turns, ratio, report

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import FloatArray, advance_pose, pose_in_frame
from adp_path_follower.core.learning.bellman import excitation
from adp_path_follower.core.learning.knot_model import KnotModel, fit
from adp_path_follower.core.learning.paper_learner import SampledModel
from adp_path_follower.core.learning.update_laws import update_weights
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import circle, lissajous
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.resources import config_file

_PERIOD = 10_000_000  # [ns]
_POSE = np.array([0.3, 0.5, 0.4])
# Errors where the far policy drives, by the grid and by the best heading.
_FAR = {"3 m off": np.array([-2.0, 2.5, 1.5]), "30 m off": np.array([-20.0, 22.0, 1.0])}
_SOLVE = "numpy.linalg.solve, 9 × 9"
_LAP, _TRACED = 1000, 2000  # ticks


class Drive:
    """A robot driven by its controller."""

    def __init__(
        self,
        file: FilePath | None = None,
        *assignments: str,
        path: Path | None = None,
        held_at: FloatArray | None = None,
    ) -> None:
        """Take the settings of a parameter file, with some changed, a path, and an error to keep.

        A robot that keeps an error [s, y, theta] is carried on beside its target.
        """
        self.settings = load_settings(Settings, "path_follower", file, assignments=assignments)
        self._driver = Driver(self.settings)
        self._driver.follow(path or lissajous())
        self._pose: FloatArray = _POSE if held_at is None else held_at
        self._held_at = held_at
        self._time = 0

    @property
    def follower(self) -> PathFollower:
        """Return the follower, after the first tick."""
        assert self._driver.follower is not None
        return self._driver.follower

    def tick(self) -> float:
        """Drive on for one period; return how long the controller took [µs]."""
        self._time += _PERIOD
        start = time.perf_counter()
        output = self._driver.step(self._pose, self._time)
        elapsed = time.perf_counter() - start
        v, w = output.command.tolist()
        if self._held_at is None:
            self._pose = advance_pose(self._pose, v, w, 1e-9 * _PERIOD)
        else:
            self._pose = pose_in_frame(self._held_at, output.target_pose)
        return 1e6 * elapsed


def parts() -> dict[str, Callable[[], object]]:
    """Return the parts of a tick, by name."""
    drives = Drive(config_file("paper.yaml")), Drive()
    for drive in drives:
        drive.tick()
    paper, default = (drive.follower for drive in drives)
    output, weights, settings = paper.step(_POSE, 0.01), paper.weights, paper.settings
    model = SampledModel(settings, paper.path, paper.profile)
    knots, ahead = KnotModel(default.settings, 0.2), default.weights.critic
    step = default.settings.learning.samples_per_step
    equations = knots.equations(slice(None), ahead, 0.1, 0.5)
    rng = np.random.default_rng(0)
    matrix, vector = np.eye(9) + 0.1 * rng.standard_normal((9, 9)), rng.standard_normal(9)
    return {
        _SOLVE: lambda: np.linalg.solve(matrix, vector),
        "path frame": lambda: paper.path.frame(3.0),
        "paper: Bellman sweep, 81 samples, 9 weights": lambda: model.sweep(
            weights.critic, weights.actor
        ),
        "paper: weight update": lambda: update_weights(
            weights, output.measured, output.sampled, settings.learning, 0.01
        ),
        "paper: certificate": lambda: excitation(output.sampled.information),
        f"default: Bellman errors, {step} samples": lambda: knots.equations(
            slice(0, step), ahead, 0.1, 0.5
        ),
        "default: solve for a knot, 80 weights": lambda: fit(equations),
    }


def consists_of() -> list[Row]:
    """Return the time of every part and tick."""
    drives = {
        "paper: control tick": Drive(config_file("paper.yaml")),
        "default: control tick, not learning": Drive(None, "learning=false"),
        "default: control tick": Drive(),
        **{f"default: control tick, {name}": Drive(held_at=place) for name, place in _FAR.items()},
    }
    times = in_turns({**parts(), **{name: drive.tick for name, drive in drives.items()}})
    return [
        Row(name, float(np.median(found)), ratio=ratio(found, times[_SOLVE]), against="solve")
        for name, found in times.items()
    ]


def long_run(count: int) -> list[Row]:
    """Return the times of consecutive ticks, and the work of the garbage collector."""
    drive = Drive()
    turns = _turns_of_a_loop_like(drive)
    collections: list[float] = []
    begun = 0.0

    def note(phase: str, _: dict[str, int]) -> None:
        nonlocal begun
        if phase == "start":
            begun = time.perf_counter()
        else:
            collections.append(1e6 * (time.perf_counter() - begun))

    ticks, loops = np.empty(count), np.empty(count)
    gc.callbacks.append(note)
    for index in range(count):
        ticks[index] = drive.tick()
        loops[index] = _plain_loop(turns)
    gc.callbacks.remove(note)
    rows = []
    for name, level in (("half within", 0.5), ("99 % within", 0.99), ("the slowest", 1.0)):
        tick, loop = (float(np.quantile(times, level)) for times in (ticks, loops))
        rows.append(Row(f"default: {count} ticks, {name}", tick, "µs", tick / loop, "plain loop"))
    rows.append(Row("garbage collections in these ticks", len(collections), ""))
    if collections:
        rows.append(Row("the longest of them", max(collections)))
    return rows


def after_rest(count: int = 500) -> list[Row]:
    """Return how long ticks take that a node does: each after the sleep of a period at 100 Hz."""
    drive = Drive()
    turns = _turns_of_a_loop_like(drive)
    rows = []
    for name, work in (("tick", drive.tick), ("plain loop", lambda: _plain_loop(turns))):
        at_once, rested = np.empty((2, count))
        for index in range(count):
            work()
            at_once[index] = work()
            time.sleep(1e-9 * _PERIOD)
            rested[index] = work()
        usual, found = float(np.median(at_once)), float(np.median(rested))
        rows.append(
            Row(f"default: {name} after 10 ms of sleep", found, "µs", found / usual, "at once")
        )
    return rows


def _turns_of_a_loop_like(drive: Drive) -> int:
    """Return how many turns of a plain loop take as long as a tick."""
    usual = np.median([drive.tick() for _ in range(500)])
    return round(500 * float(usual) / _plain_loop(500 * 20)) * 20


def _plain_loop(turns: int) -> float:
    """Return how long so many turns of a loop take [µs]."""
    start = time.perf_counter()
    total = 0.0
    for turn in range(turns):
        total += turn * 0.5
    return 1e6 * (time.perf_counter() - start)


def allocations() -> list[Row]:
    """Return the memory that ticks keep, and the most that one has at once."""
    rows = []
    for name, assignments in (("not learning", ("learning=false",)), ("learning", ())):
        drive = Drive(None, *assignments, path=circle(0.5))
        tracemalloc.start()
        for _ in range(_LAP):  # whose knots are known then
            drive.tick()
        gc.collect()
        most = np.zeros(_TRACED)  # laid out before: a list would grow
        before, _ = tracemalloc.get_traced_memory()
        for index in range(_TRACED):
            present, _ = tracemalloc.get_traced_memory()
            tracemalloc.reset_peak()
            drive.tick()
            most[index] = tracemalloc.get_traced_memory()[1] - present
        gc.collect()
        grown = (tracemalloc.get_traced_memory()[0] - before) / _TRACED
        tracemalloc.stop()
        usual = float(np.median(most)) / 1e3
        rows.append(Row(f"default, {name}: kept of the memory of a tick", grown, "B"))
        rows.append(Row(f"default, {name}: memory that a tick has at once", usual, "kB"))
    return rows


def main() -> None:
    """Print the table, and write it if asked."""
    parser = arguments(__doc__)
    parser.add_argument("--ticks", type=int, default=100_000, help="of the long run")
    given = parser.parse_args()
    rows = [*consists_of(), *long_run(given.ticks), *after_rest(), *allocations()]
    report(rows, given.json)


if __name__ == "__main__":
    main()
