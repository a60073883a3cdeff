"""The controller beside its peers: the same starts, the same paths, the same cost."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from adp_path_follower.analysis.projection import project
from adp_path_follower.baselines.registry import PEERS
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.follower import PathFollower
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.parameter_file import load_settings
from adp_path_follower.core.path import Path
from adp_path_follower.core.schema import build, flatten, setting_fields
from adp_path_follower.core.settings import Settings
from adp_path_follower.optimum.collocation import OptimumSolver
from adp_path_follower.optimum.problem import OptimumError
from adp_path_follower.shared_files import config_file
from adp_path_follower.simulation import (
    PAPER_START,
    ControllerFactory,
    SimulationResult,
    simulate,
)
from sim_unicycle.fault_script import FaultScript
from sim_unicycle.settings import PlantSettings

OWN = {
    "adp": "Approximate optimal control, learned before the start (warm)",
    "adp_cold": "The same, learning from the first step on",
    "paper": "The paper's laws and gains, learning from the first step on",
}
CONTROLLERS: dict[str, str] = {**OWN, **{name: peer.description for name, peer in PEERS.items()}}

_RATE = 100.0  # [Hz]
_TRANSIENT = 10.0  # [s] after which the lap counts
_LONGEST_LAP = 300.0  # [s] of a lap, or of an open path
_OFF_PATH = 0.5  # [m] from the path at the end: that run has failed


@dataclass(frozen=True)
class Contender:
    """One controller and how it is run.

    Attributes:
        name: As in `CONTROLLERS`.
        settings: What it is made with.
        factory: Makes it.
        learning: How it starts: "cold" or "warm".
        rate: Control steps per second [Hz].

    """

    name: str
    settings: Settings
    factory: ControllerFactory
    learning: str
    rate: float


@dataclass(frozen=True)
class Outcome:
    """How one controller did on one path.

    Attributes:
        name: Controller.
        cost_ratio: J/J* of each start, shape (B,); NaN where J* is not known or the run failed.
        cost: J of each start, shape (B,).
        failed: Runs that were lost, or ended more than 0.5 m from the path, shape (B,).
        settling_time: Until |e| stays below 0.05 [s]; infinite where it does not, shape (B,).
        effort: Integral of u^T R u of each start, shape (B,).
        lap_time: Times of the lap after its first 10 s [s], shape (T,).
        cross_track: Distance from the path then, positive to the left [m], shape (T,).
        step_time: Median computing time of one control step of one robot [s].

    """

    name: str
    cost_ratio: FloatArray
    cost: FloatArray
    failed: np.ndarray
    settling_time: FloatArray
    effort: FloatArray
    lap_time: FloatArray
    cross_track: FloatArray
    step_time: float

    def quantile(self, share: float) -> float:
        """Return a quantile of J/J* over the starts with a known optimum; a failure is infinite.

        Of the two starts beside it the worse one; NaN if there is no start with an optimum.
        """
        ratio = np.where(self.failed, math.inf, self.cost_ratio)
        known = ratio[~np.isnan(ratio)]
        return float(np.quantile(known, share, method="higher")) if len(known) else math.nan

    @property
    def cross_track_rms(self) -> float:
        """Return the RMS distance from the path over the lap [m]."""
        return float(np.sqrt(np.mean(self.cross_track**2)))

    @property
    def cross_track_max(self) -> float:
        """Return the greatest distance from the path over the lap [m]."""
        return float(np.abs(self.cross_track).max())


@dataclass(frozen=True)
class Comparison:
    """All controllers on one path.

    Attributes:
        path_name: As the user names it.
        starts: Initial errors, shape (B, 3).
        optimal_cost: J* of each start, shape (B,); NaN where no optimum was found.
        problems: Why, one sentence for each such start.
        outcomes: One for each controller.

    """

    path_name: str
    starts: FloatArray
    optimal_cost: FloatArray
    problems: tuple[str, ...]
    outcomes: tuple[Outcome, ...]


def contenders(settings: Settings, names: Sequence[str]) -> list[Contender]:
    """Return the controllers of these names.

    Raises:
        AdpError: There is no such controller.

    """
    found = []
    for name in names:
        if name in ("adp", "adp_cold"):
            mode = "warm" if name == "adp" else "cold"
            found.append(Contender(name, settings, PathFollower, mode, _RATE))
        elif name == "paper":
            found.append(Contender(name, _paper_laws(settings), PathFollower, "cold", _RATE))
        elif name in PEERS:
            peer = PEERS[name]
            rate = peer.control_rate or _RATE
            found.append(Contender(name, settings, peer.factory, "frozen", rate))
        else:
            raise AdpError(f"unknown controller '{name}': choose from {', '.join(CONTROLLERS)}")
    return found


def _paper_laws(settings: Settings) -> Settings:
    """Return the paper's learner for the target, cost and limits of other settings."""
    printed = flatten(load_settings(Settings, "path_follower", config_file("paper.yaml")))
    task = flatten(settings)
    groups = {field.name: field.group for field in setting_fields(Settings)}
    kept = {
        name: value
        for name, value in task.items()
        if groups[name] in ("target", "cost", "limits", "motion")
    }
    return build(Settings, {**printed, **kept})


def compare(
    settings: Settings,
    path_name: str,
    path: Path,
    starts: FloatArray,
    names: Sequence[str],
    *,
    start_arc_length: float = 0.0,
    duration: float = 30.0,
    plant: PlantSettings | None = None,
    faults: FaultScript | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Comparison:
    """Run controllers from the same starts, and beside the offline optimum.

    Args:
        settings: Target, cost and limits of all; the learner of "adp".
        path_name: As it is shown.
        path: The path.
        starts: Initial errors, shape (B, 3).
        names: Controllers, of `CONTROLLERS`.
        start_arc_length: Where the virtual target starts [m].
        duration: Time over which the cost is compared [s].
        plant: Imperfections of the robot, the same noise for every controller; J* is the ideal
            robot's in any case.
        faults: How they change with time.
        progress: Called with the fraction that is done.

    """
    chosen = contenders(settings, names)
    for item in chosen:  # what cannot run is said before the long work
        item.factory(item.settings, path, np.full(1, start_arc_length))
    parts = len(chosen) + 1
    optimal, problems = _optima(
        settings, path, starts, start_arc_length, duration, lambda part: progress(part / parts)
    )
    outcomes = []
    for index, item in enumerate(chosen):

        def advance(part: float, done: int = index + 1) -> None:
            progress((done + part) / parts)

        run = functools.partial(
            simulate,
            item.settings,
            path,
            start_arc_length=start_arc_length,
            rate=item.rate,
            learning=item.learning,
            plant=plant,
            faults=faults,
            controller=item.factory,
        )
        outcomes.append(_outcome(item, run, path, starts, duration, optimal, advance))
    return Comparison(path_name, starts, optimal, tuple(problems), tuple(outcomes))


def _optima(
    settings: Settings,
    path: Path,
    starts: FloatArray,
    start_arc_length: float,
    duration: float,
    progress: Callable[[float], None],
) -> tuple[FloatArray, list[str]]:
    solver = OptimumSolver(settings, path, start_arc_length, duration)
    costs, problems = np.full(len(starts), math.nan), []
    for index, start in enumerate(starts):
        try:
            costs[index] = solver.solve(start).cost
        except OptimumError as error:
            problems.append(str(error))
        progress((index + 1) / len(starts))
    return costs, problems


def _outcome(
    item: Contender,
    simulated: Callable[..., SimulationResult],
    path: Path,
    starts: FloatArray,
    duration: float,
    optimal: FloatArray,
    progress: Callable[[float], None],
) -> Outcome:
    def run(from_starts: FloatArray, time: float, record: bool, first: float) -> SimulationResult:
        return simulated(
            starts=from_starts,
            duration=time,
            record=record,
            progress=lambda part: progress(first + 0.5 * part),
        )

    many = run(starts, duration, False, 0.0)
    lap = min(path.length / item.settings.target.desired_speed, _LONGEST_LAP)
    single = run(np.array([PAPER_START]), _TRANSIENT + lap, True, 0.5)
    assert single.trajectories is not None  # record=True
    counted = single.trajectories.time >= _TRANSIENT
    off_path = np.abs(many.final_error[:, 1]) > _OFF_PATH
    failed = many.failed | off_path | ~np.isfinite(many.cost)
    return Outcome(
        name=item.name,
        cost_ratio=np.where(failed, math.nan, many.cost / optimal),
        cost=many.cost,
        failed=failed,
        settling_time=many.settling_time,
        effort=many.effort,
        lap_time=single.trajectories.time[counted],
        cross_track=project(path, single.trajectories.pose[0]).cross_track[counted],
        step_time=single.step_time,
    )
