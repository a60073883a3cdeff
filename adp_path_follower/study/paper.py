"""The paper's simulation, beside the optimum that it compares with by eye.

Two questions are answered with numbers: how near do the printed laws come to the optimum, and do
the printed constants meet the conditions of the paper's own stability theorem?
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path as FilePath

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.geometry import FloatArray, pose_in_frame
from adp_path_follower.core.learning.bellman import excitation
from adp_path_follower.core.learning.paper_learner import SampledModel
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import update
from adp_path_follower.drawing.charts import ReferenceMotion, RunView
from adp_path_follower.drawing.figure_style import COLORS
from adp_path_follower.drawing.run_figures import Drawings, draw_figures, legend_above, save_figures
from adp_path_follower.resources import config_file
from adp_path_follower.study.optimum.collocation import OptimumSolver
from adp_path_follower.study.optimum.costate import solve_costates
from adp_path_follower.study.optimum.problem import Motion
from adp_path_follower.study.simulation.simulate import PAPER_START, simulate
from adp_path_follower.study.simulation.trajectories import Trajectories

DURATION = 40.0  # [s] of the comparison
LONG_DURATION = 600.0  # [s] after which the unlearning shows
GRIDS: tuple[tuple[float, float, float, float], ...] = (
    (1.0, 1.0, 1.0, 0.5),
    (0.5, 0.5, 0.5, 0.5),
    (0.3, 0.3, 0.3, 0.3),
)

_RATE = 100.0  # [Hz]
_LONG_RATE = 50.0  # [Hz]
_CIRCLE_PERIOD = 0.5  # [s] between two circles of the optimum, so that curves show
_VISITED = np.concatenate([np.arange(0.0, 4.0, 0.25), np.arange(4.0, 12.5, 1.0)])  # [s]


@dataclass(frozen=True)
class PaperRun:
    """The printed laws with one choice of what the paper leaves open."""

    name: str  # the choice, in words
    settings: Settings  # settings of the run
    cost: float  # J over 40 s
    state_distance: float  # RMS distance of e to the optimum's over 40 s
    input_distance: float  # RMS distance of u to the optimum's over 40 s
    trajectories: Trajectories  # the run


@dataclass(frozen=True)
class Theorem:
    """The quantities of the paper's stability theorem along a run."""

    time: FloatArray  # times at which the value function was evaluated [s], shape (M,)
    value: FloatArray  # V* at the states visited then, shape (M,)
    residual: FloatArray  # norm of eps' = dV*/dzeta - sigma'^T W* there, shape (M,)
    # W*, the weights that fit dV*/dzeta best on the visited states, shape (L,).
    ideal_weights: FloatArray
    lyapunov: FloatArray  # V* + |W* - Wc|^2 / 2 + |W* - Wa|^2 / 2, shape (M,)
    drift_bound: float  # L_f, the largest |f(zeta)| / |zeta| over the visited states
    excitation_time: FloatArray  # shape (T,) [s]
    excitation: FloatArray  # smallest singular value of the rank condition's matrix, shape (T,)
    excitation_needed: float  # bound that the second gain condition sets
    cost_needed: float  # bound of the first gain condition for the least eigenvalue of Q
    least_state_cost: float  # that eigenvalue, q_min


@dataclass(frozen=True)
class Reproduction:
    """Everything that `reproduce` finds."""

    path: Path  # the paper's figure eight
    optimum: Motion  # the offline optimum
    runs: tuple[PaperRun, ...]  # the initial weights without learning, then each grid
    shipped: PaperRun  # the one of them with the grid of config/paper.yaml
    long_runs: tuple[PaperRun, ...]  # each grid, for long
    theorem: Theorem  # the theorem's quantities along the shipped run


def reproduce(
    progress: Callable[[float], None], long_duration: float = LONG_DURATION
) -> Reproduction:
    """Run the paper's simulation with each grid and for long [s], the optimum and the theorem."""
    printed = load_settings(Settings, "path_follower", config_file("paper.yaml"))
    path = lissajous()
    optimum = OptimumSolver(printed, path, horizon=DURATION).solve(np.array(PAPER_START)).motion
    choices: list[tuple[str, Settings, str]] = [("initial weights, no learning", printed, "frozen")]
    for grid in GRIDS:
        name = f"grid {', '.join(f'{width:g}' for width in grid)}"
        choices.append((name, update(printed, {"sample_half_widths": grid}), "cold"))
    runs, long_runs = [], []
    for index, (name, settings, learning) in enumerate(choices):
        runs.append(_run(name, settings, path, learning, DURATION, _RATE, optimum))
        if learning == "cold":
            long = _run(name, settings, path, learning, long_duration, _LONG_RATE, optimum)
            long_runs.append(long)
        progress(0.5 * (index + 1) / len(choices))
    shipped = next(run for run in runs[1:] if run.settings == printed)
    return Reproduction(
        path=path,
        optimum=optimum,
        runs=tuple(runs),
        shipped=shipped,
        long_runs=tuple(long_runs),
        theorem=_theorem(shipped, path, lambda part: progress(0.5 + 0.5 * part)),
    )


def _run(
    name: str,
    settings: Settings,
    path: Path,
    learning: str,
    duration: float,
    rate: float,
    optimum: Motion,
) -> PaperRun:
    result = simulate(settings, path, duration=duration, rate=rate, learning=learning, record=True)
    assert result.trajectories is not None  # record=True
    found = result.trajectories
    compared = found.time <= DURATION

    def distance(values: FloatArray, reference: FloatArray) -> float:
        columns = [np.interp(found.time[compared], optimum.time, column) for column in reference.T]
        apart = values[0, compared] - np.stack(columns, axis=1)
        return float(np.sqrt((apart**2).sum(axis=1).mean()))

    return PaperRun(
        name=name,
        settings=settings,
        cost=float(result.cost[0]),
        state_distance=distance(found.error, optimum.state[:, :3]),
        input_distance=distance(found.modified_input, optimum.modified_input),
        trajectories=found,
    )


def _theorem(run: PaperRun, path: Path, progress: Callable[[float], None]) -> Theorem:
    """Evaluate the theorem along a run; the optimum from a state has the value and its gradient."""
    settings, found = run.settings, run.trajectories
    target, learning = settings.target, settings.learning
    steps = np.searchsorted(found.time, _VISITED - 1e-9)
    value, gradient = [], []
    for step in steps:
        place = float(found.arc_length[0, step])
        local = OptimumSolver(settings, path, place)
        optimum = local.solve(found.error[0, step])
        extremal = solve_costates(local.problem, optimum.motion)
        value.append(extremal.cost)
        phi = error_dynamics.path_state(np.array(place), target)
        by_phi = extremal.costates[3] / (target.path_state_gain * (1.0 - phi**2))
        gradient.append(np.append(extremal.costates[:3], by_phi))
        progress(len(value) / len(steps))
    arc_length = found.arc_length[0, steps]
    phi = error_dynamics.path_state(arc_length, target)
    zeta = np.column_stack([found.error[0, steps], phi])
    basis = learning.value_basis.gradient(zeta)  # (M, L, 4)
    count, size, _ = basis.shape
    system = basis.transpose(0, 2, 1).reshape(4 * count, size)
    ideal, *_ = np.linalg.lstsq(system, np.array(gradient).ravel(), rcond=None)
    residual = np.array(gradient) - np.einsum("mlz,l->mz", basis, ideal)
    residual_norm = np.linalg.norm(residual, axis=1)
    curvature = path.curvature(arc_length)
    drift = error_dynamics.drift(zeta, curvature, target, target.desired_speed)
    drift_bound = float((np.linalg.norm(drift, axis=1) / np.linalg.norm(zeta, axis=1)).max())
    critic = found.critic_weights[0]
    actor = found.actor_weights[0]
    apart = ((ideal - critic[steps]) ** 2).sum(axis=1) + ((ideal - actor[steps]) ** 2).sum(axis=1)
    model = SampledModel(settings, path, SpeedProfile(path, settings))
    every = slice(None, None, 10)
    measured = learning.critic_gain_measured * float(residual_norm.max()) * drift_bound
    ratio = len(model) / (2.0 * learning.critic_gain_sampled)
    return Theorem(
        time=_VISITED,
        value=np.array(value),
        residual=residual_norm,
        ideal_weights=ideal,
        lyapunov=np.array(value) + 0.5 * apart,
        drift_bound=drift_bound,
        excitation_time=found.time[every],
        excitation=excitation(model.sweep(critic[every], actor[every]).information),
        excitation_needed=ratio * (learning.actor_gain + measured),
        cost_needed=0.5 * measured,
        least_state_cost=float(np.linalg.eigvalsh(settings.cost.state_cost_matrix())[0]),
    )


def draw_paper(found: Reproduction, directory: FilePath) -> list[FilePath]:
    """Draw figures 2 to 5 of the shipped grid, the long run and the theorem; return the files."""
    labels, run = found.shipped.settings.learning.value_basis.labels, found.shipped.trajectories
    view = RunView(
        time=run.time,
        path=found.path.points(0.05)[:, :2],
        track=run.pose[0],
        target=found.path.frame(run.arc_length[0]).pose[:, :2],
        error=run.error[0],
        modified_input=run.modified_input[0],
        weight_time=run.time,
        critic_weights=run.critic_weights[0],
        actor_weights=run.actor_weights[0],
        labels=labels,
    )
    files = draw_figures(view, directory, _thinned(found.optimum, found.path))
    drawings: Drawings = {
        "long_run.png": ((5.0, 5.0), partial(_long_run, found.long_runs, labels)),
        "excitation.png": ((5.0, 3.6), partial(_excitation, found.theorem)),
        "gain_conditions.png": ((5.0, 3.6), partial(_gain_conditions, found.theorem)),
        "lyapunov.png": ((5.0, 3.6), partial(_lyapunov, found.theorem)),
    }
    return files + save_figures(drawings, directory)


def _thinned(optimum: Motion, path: Path) -> ReferenceMotion:
    """Return the collocation points that follow one another by a period or more."""
    every = np.arange(0.0, optimum.time[-1], _CIRCLE_PERIOD)
    kept = np.unique(np.searchsorted(optimum.time, every))
    error, place = optimum.state[kept, :3], optimum.state[kept, 3]
    position = pose_in_frame(error, path.frame(place).pose)[:, :2]
    return ReferenceMotion(optimum.time[kept], error, optimum.modified_input[kept], position)


def _long_run(runs: tuple[PaperRun, ...], labels: tuple[str, ...], figure: Figure) -> None:
    lateral, weights = figure.subplots(2, 1, sharex=True)
    for color, run in zip(COLORS, runs, strict=False):
        time = run.trajectories.time
        lateral.plot(time, run.trajectories.error[0, :, 1], color=color, label=run.name)
        for label, style in (("y θ", "-"), ("y²", "--")):
            column = labels.index(label)
            weights.plot(
                time, run.trajectories.actor_weights[0, :, column], color=color, linestyle=style
            )
    weights.plot([], [], "k-", label="weight of y θ")
    weights.plot([], [], "k--", label="weight of y²")
    title = "The printed laws for ten minutes:\nlateral regulation is unlearned"
    figure.suptitle(title)
    lateral.set(ylabel="y [m]", ylim=(-0.6, 0.6))
    weights.set(xlabel="time [s]", ylabel="actor weight")
    for axes in (lateral, weights):
        legend_above(axes, 2)
    figure.tight_layout()


def _excitation(theorem: Theorem, figure: Figure) -> None:
    axes = _panel(figure, "Rank condition: Σ ω ωᵀ / p")
    axes.plot(theorem.excitation_time, theorem.excitation, color=COLORS[0])
    axes.set(xlabel="time [s]", ylabel="smallest singular value", ylim=(0.0, None))


def _gain_conditions(theorem: Theorem, figure: Figure) -> None:
    axes = _panel(figure, "The theorem's sufficient gain conditions")
    names = ("q_min", "c_min")
    has = (theorem.least_state_cost, float(theorem.excitation.min()))
    needs = (theorem.cost_needed, theorem.excitation_needed)
    place = np.arange(len(names))
    axes.bar(place - 0.18, has, 0.36, color=COLORS[0], label="is")
    axes.bar(place + 0.18, needs, 0.36, color=COLORS[1], label="must be above")
    for x, values in ((place - 0.18, has), (place + 0.18, needs)):
        for position, value in zip(x, values, strict=True):
            axes.text(position, value, f"{value:.3g}", ha="center", va="bottom")
    axes.set(yscale="log", ylabel="value")
    axes.set_xticks(place, names)
    legend_above(axes)


def _lyapunov(theorem: Theorem, figure: Figure) -> None:
    axes = _panel(figure, "Lyapunov candidate\nV_L = V* + ½‖W̃c‖² + ½‖W̃a‖²")
    axes.plot(theorem.time, theorem.lyapunov, "-o", color=COLORS[0], label="V_L", markersize=3)
    axes.plot(theorem.time, theorem.value, "-o", color=COLORS[1], label="V* alone", markersize=3)
    axes.plot(theorem.time, theorem.residual, "-o", color=COLORS[2], label="‖ε′‖", markersize=3)
    axes.set(xlabel="time [s]", ylabel="value", yscale="log")
    legend_above(axes)


def _panel(figure: Figure, title: str) -> Axes:
    figure.set_layout_engine("tight")
    axes = figure.subplots()
    axes.set_title(title)
    return axes
