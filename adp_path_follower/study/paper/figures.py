"""Figures of what the paper does not show: the long run and the theorem's quantities."""

from pathlib import Path as FilePath

import numpy as np
from matplotlib.figure import Figure

from adp_path_follower.core.path.curve import Path
from adp_path_follower.drawing.figure_style import COLORS
from adp_path_follower.drawing.run_figures import RunView, draw_figures, save_figures
from adp_path_follower.study.paper.reproduce import PaperRun, Reproduction, Theorem
from adp_path_follower.study.simulation.trajectories import Trajectories


def draw_paper(found: Reproduction, directory: FilePath) -> list[FilePath]:
    """Draw figures 2 to 5 of the shipped grid, the long run and the theorem; return the files."""
    labels = found.shipped.settings.learning.value_basis.labels
    view = view_of_simulation(found.shipped.trajectories, 0, found.path, labels)
    files = draw_figures(view, directory, found.optimum)
    drawings = {
        "long_run.png": lambda: _long_run(found.long_runs, labels),
        "excitation.png": lambda: _excitation(found.theorem),
        "gain_conditions.png": lambda: _gain_conditions(found.theorem),
        "lyapunov.png": lambda: _lyapunov(found.theorem),
    }
    return files + save_figures(drawings, directory)


def _long_run(runs: tuple[PaperRun, ...], labels: tuple[str, ...]) -> Figure:
    figure = Figure(figsize=(9.0, 6.5))
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
    lateral.set_ylabel("y [m]")
    lateral.set_ylim(-0.6, 0.6)
    weights.set_ylabel("actor weight")
    weights.set_xlabel("time [s]")
    lateral.set_title("The printed laws for ten minutes: lateral regulation is unlearned")
    for axes in (lateral, weights):
        axes.legend(loc="upper right")
    figure.tight_layout()
    return figure


def _excitation(theorem: Theorem) -> Figure:
    figure = Figure(figsize=(7.0, 3.8))
    axes = figure.subplots()
    axes.plot(theorem.excitation_time, theorem.excitation, color=COLORS[0])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("smallest singular value")
    axes.set_ylim(bottom=0.0)
    axes.set_title("Rank condition: Σ ω ωᵀ / p")
    figure.tight_layout()
    return figure


def _gain_conditions(theorem: Theorem) -> Figure:
    figure = Figure(figsize=(7.0, 3.8))
    axes = figure.subplots()
    names = ("q_min", "c_min")
    has = (theorem.least_state_cost, float(theorem.excitation.min()))
    needs = (theorem.cost_needed, theorem.excitation_needed)
    place = np.arange(len(names))
    axes.bar(place - 0.18, has, 0.36, color=COLORS[0], label="is")
    axes.bar(place + 0.18, needs, 0.36, color=COLORS[1], label="must be above")
    for x, values in ((place - 0.18, has), (place + 0.18, needs)):
        for position, value in zip(x, values, strict=True):
            axes.text(position, value, f"{value:.3g}", ha="center", va="bottom")
    axes.set_yscale("log")
    axes.set_xticks(place, names)
    axes.set_title("The theorem's sufficient gain conditions")
    axes.legend()
    figure.tight_layout()
    return figure


def _lyapunov(theorem: Theorem) -> Figure:
    figure = Figure(figsize=(7.0, 3.8))
    axes = figure.subplots()
    axes.plot(theorem.time, theorem.lyapunov, "-o", color=COLORS[0], label="V_L", markersize=3)
    axes.plot(theorem.time, theorem.value, "-o", color=COLORS[1], label="V* alone", markersize=3)
    axes.plot(theorem.time, theorem.residual, "-o", color=COLORS[2], label="‖ε′‖", markersize=3)
    axes.set_yscale("log")
    axes.set_xlabel("time [s]")
    axes.set_title("Lyapunov candidate V_L = V* + ½‖W̃c‖² + ½‖W̃a‖²")
    axes.legend()
    figure.tight_layout()
    return figure


def view_of_simulation(
    trajectories: Trajectories, run: int, path: Path, labels: tuple[str, ...]
) -> RunView:
    """Return the view of one run of a simulation."""
    return RunView(
        time=trajectories.time,
        path=path.points(0.05)[:, :2],
        track=trajectories.pose[run],
        target=path.frame(trajectories.arc_length[run]).pose[:, :2],
        error=trajectories.error[run],
        modified_input=trajectories.modified_input[run],
        weight_time=trajectories.time,
        critic_weights=trajectories.critic_weights[run],
        actor_weights=trajectories.actor_weights[run],
        labels=labels,
    )
