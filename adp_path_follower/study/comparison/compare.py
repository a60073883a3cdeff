"""The controller beside its peers: the same starts, the same paths, the same cost."""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from adp_path_follower import criteria
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.drive import project
from adp_path_follower.core.path.speed_profile import SpeedReference, passing_times
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import update
from adp_path_follower.drawing.charts import ShownRun
from adp_path_follower.study.comparison.controllers import RATE, Contender, contender
from adp_path_follower.study.optimum.collocation import Optimum, OptimumSolver
from adp_path_follower.study.optimum.problem import Motion, OptimumError, motions_of
from adp_path_follower.study.simulation.shown import shown_run
from adp_path_follower.study.simulation.simulate import SimulationResult, simulate
from sim_unicycle.fault_script import FaultScript
from sim_unicycle.settings import PlantSettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LONGEST_LAP = 300.0  # [s] of a lap, or of an open path
_AGREEMENT = 1e-5  # between a controller's cost and J*: both are integrals of motions


@dataclass(frozen=True)
class Outcome:
    """How one controller did on one path.

    Attributes:
        name: Controller.
        cost_ratio: J/J* of each start, shape (B,); NaN where J* is not known or the run failed.
        cost: J of each start, shape (B,); NaN where the start is invalid or the run was lost.
        failed: Runs that were lost, or ended more than 0.5 m from the path, shape (B,).
        settling_time: Until |e| stays below 0.05 [s]; infinite where it does not, shape (B,).
        effort: Integral of u^T R u of each start, shape (B,).
        lap_time: Times of the lap after its first 10 s [s], shape (T,); T = 0 if the path ends.
        cross_track: Distance from the path then, positive to the left [m], shape (T,).
        step_time: Median computing time of one control step of one robot [s].
        lap: The lap as a page shows it.

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
    lap: ShownRun

    def quantile(self, share: float) -> float:
        """Return a quantile of J/J* over the starts with a known optimum; a failure is infinite.

        The worse of two starts counts, but for the median; NaN without a start that has an optimum.
        """
        ratio = np.where(self.failed, math.inf, self.cost_ratio)
        known = ratio[~np.isnan(ratio)]
        if not len(known):
            return math.nan
        return float(
            np.median(known) if share == 0.5 else np.quantile(known, share, method="higher")
        )

    @property
    def cross_track_rms(self) -> float:
        """Return the RMS distance from the path over the lap [m]; NaN without a lap."""
        found = self.cross_track
        return float(np.sqrt(np.mean(found**2))) if len(found) else math.nan

    @property
    def cross_track_max(self) -> float:
        """Return the greatest distance from the path over the lap [m]; NaN without a lap."""
        found = self.cross_track
        return float(np.abs(found).max()) if len(found) else math.nan


@dataclass(frozen=True)
class Comparison:
    """All controllers on one path.

    Attributes:
        path_name: As the user names it.
        starts: Initial errors, shape (B, 3).
        optimal_cost: J* of each start, shape (B,); NaN where no optimum was found.
        problems: Why, one sentence for each such start.
        notes: Further sentences about J*.
        outcomes: One for each controller.

    """

    path_name: str
    starts: FloatArray
    optimal_cost: FloatArray
    problems: tuple[str, ...]
    notes: tuple[str, ...]
    outcomes: tuple[Outcome, ...]

    def __repr__(self) -> str:
        """Return the median J/J* of each controller in one line."""
        ratios = ", ".join(f"{item.name} {item.quantile(0.5):.4f}" for item in self.outcomes)
        return f"Comparison({self.path_name}, {len(self.starts)} starts, median J/J*: {ratios})"

    def plot(self, axes: "Axes | None" = None) -> "Axes":
        """Plot the loss J/J* - 1 of each start, on given axes or new ones; return them."""
        from adp_path_follower.drawing.run_figures import plotted
        from adp_path_follower.study.comparison.figures import draw_cost

        return plotted(lambda place: draw_cost(place, self), axes)


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

    Target, cost and limits of all are those of `settings`, as is the learner of "adp". The starts
    are errors of shape (B, 3) to a virtual target at `start_arc_length` [m]; the cost is that over
    `duration` [s]. All see the same noise of `plant` and `faults`; J* is that of `plant` known in
    full, without noise, slip, friction and faults.
    `progress` takes the fraction done. Raises AdpError for an unknown controller, no start, limits
    that the optimum does not know, or a controller that does not know those of the others.
    """
    # The first command of all, and of J*, may be what accelerations allow in the same period.
    settings = update(settings, {"controller_frequency": RATE})
    robot = plant or PlantSettings()
    chosen = [contender(name, settings, robot.model) for name in names]
    known = np.asarray(np.isfinite(starts).all(axis=1))
    if not known.any():
        raise AdpError("starts must be finite values s, y, theta, three for each start")
    solver = OptimumSolver(settings, path, start_arc_length, duration, robot)
    reference = solver.problem.reference
    uneven = reference.varies or settings.motion.limited
    _check_factories(chosen, path, start_arc_length, uneven)
    count, among, lap = len(starts), len(chosen), _lap(path, start_arc_length, reference)
    ways: list[list[Motion]] = [[] for _ in starts]
    outcomes = []

    def part(first: int, length: int = 1) -> Callable[[float], None]:
        """Return what takes the fraction of some parts: two for each controller and the optima."""
        return lambda done: progress((first + length * done) / (2 * among + 2))

    for index, item in enumerate(chosen):
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
            record=True,
        )
        many = run(starts[known], duration=duration, record_weights=False, progress=part(2 * index))
        single = run(duration=lap, progress=part(2 * index + 1))
        outcomes.append(_outcome(item, path, known, many, single, among, faults))
        for own, motions in zip(ways, motions_of(many.trajectories, known), strict=True):
            own += motions
    pushed = any(robot.push) or (faults is not None and faults.entries)  # which may help
    costs = np.zeros((0, count)) if pushed else np.array([item.cost for item in outcomes])
    optima, problems = _optima(solver, starts, ways, costs, part(2 * among, 2))
    optimal = np.array([math.nan if optimum is None else optimum.cost for optimum in optima])
    rated = tuple(
        replace(found, cost_ratio=np.where(found.failed, math.nan, found.cost / optimal))
        for found in outcomes
    )
    notes = _notes(starts, optima, duration)
    return Comparison(path_name, starts, optimal, tuple(problems), notes, rated)


def _check_factories(
    chosen: Sequence[Contender], path: Path, start_arc_length: float, uneven: bool
) -> None:
    """Raise AdpError before the long work for what cannot run, or not where speeds are uneven."""
    for item in chosen:
        made = item.factory(item.settings, path, np.full(1, start_arc_length))
        if uneven and not hasattr(made, "reference"):
            raise AdpError(
                f"controller '{item.name}' knows neither a speed that varies along the path nor "
                "limits of acceleration: derive it from PeerController, or set all max_*_accel, "
                "max_linear_decel and desired_speed so that there are none"
            )


def _lap(path: Path, start_arc_length: float, reference: SpeedReference) -> float:
    """Return how long a robot drives [s] for a lap after the transient, or to the path's end."""
    end = start_arc_length + path.length if path.closed else path.length
    places = np.linspace(start_arc_length, end, len(path.samples.arc_length))
    lap = float(passing_times(reference, places)[-1])
    whole = criteria.TRANSIENT + min(lap, _LONGEST_LAP)
    return whole if path.closed else max(min(lap, whole), 1.0)


def _optima(
    solver: OptimumSolver,
    starts: FloatArray,
    ways: Sequence[Sequence[Motion]],
    costs: FloatArray,
    progress: Callable[[float], None],
) -> tuple[list[Optimum | None], list[str]]:
    """Return the optimum of each start, None where there is none, and sentences that say why.

    An optimum above one of the costs (controllers, B) is none.
    """
    found: list[Optimum | None] = []
    problems = []
    for index, start in enumerate(starts):
        try:
            optimum = solver.solve(start, ways[index])
            least = float(np.nanmin(costs[:, index], initial=math.inf))
            doubt = max(_AGREEMENT, optimum.mesh_change)
            if least < optimum.cost * (1.0 - doubt) - _AGREEMENT:
                raise OptimumError(
                    f"optimum from the start {start.tolist()} is only a local one: it costs "
                    f"{optimum.cost:.7g}, but a controller {least:.7g}; no J/J* is told of it"
                )
            found.append(optimum)
        except OptimumError as error:
            found.append(None)
            problems.append(str(error))
        progress((index + 1) / len(starts))
    return found, problems


def _notes(
    starts: FloatArray, optima: Sequence[Optimum | None], duration: float
) -> tuple[str, ...]:
    notes = []
    for start, optimum in zip(starts, optima, strict=True):
        if optimum is not None and optimum.local_optima:
            notes.append(f"from {start.tolist()} {optimum.local_optima}")
    changes = [optimum.horizon_change for optimum in optima if optimum and not optimum.settled]
    if changes:
        notes.append(
            f"J* of {len(changes)} starts is the best over {duration:g} s alone and changes by up "
            f"to {max(changes):.1e} with half as long again, but controllers look further: give a "
            "longer --duration"
        )
    return tuple(notes)


def _outcome(
    item: Contender,
    path: Path,
    known: np.ndarray,
    many: SimulationResult,
    single: SimulationResult,
    among: int,
    faults: FaultScript | None,
) -> Outcome:
    """Return how a controller did from the known starts (B,) and on a lap, without J/J*."""

    def of_all(values: FloatArray) -> FloatArray:
        """Return values of the starts that could be run as values of all, NaN for the others."""
        every = np.full(len(known), math.nan)
        every[known] = values
        return every

    lap = single.trajectories
    assert lap is not None  # record=True
    counted = lap.time >= criteria.TRANSIENT
    if not path.closed:
        counted &= lap.arc_length[0] <= path.length
    off_path = criteria.is_off_path(many.final_error[:, 1])
    failed = np.zeros(len(known), dtype=bool)
    failed[known] = many.failed | off_path | ~np.isfinite(many.cost)
    return Outcome(
        name=item.name,
        cost_ratio=np.full(len(known), math.nan),
        cost=of_all(many.cost),
        failed=failed,
        settling_time=of_all(many.settling_time),
        effort=of_all(many.effort),
        lap_time=lap.time[counted],
        cross_track=project(path, lap.pose[0]).cross_track[counted],
        step_time=single.step_time,
        lap=shown_run(item.name, path, item.settings, lap, among=among, faults=faults),
    )
