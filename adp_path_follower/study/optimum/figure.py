"""Optimal motions as a figure."""

from pathlib import Path as FilePath

from matplotlib.figure import Figure

from adp_path_follower.drawing.figure_style import color
from adp_path_follower.drawing.run_figures import save_figures
from adp_path_follower.study.optimum.problem import Motion

_LABELS = ("s [m]", "y [m]", "θ [rad]", "v_e [m/s]", "ω_e [rad/s]")
_SHOWN = 15.0  # [s]: the rest is at rest


def draw_optima(motions: list[Motion], file: FilePath) -> None:
    """Draw errors and inputs of optimal motions over time, a curve for each start."""
    save_figures({file.name: lambda: _figure(motions)}, file.parent)


def _figure(motions: list[Motion]) -> Figure:
    figure = Figure(figsize=(9.0, 7.0))
    axes = figure.subplots(len(_LABELS), 1, sharex=True)
    for index, motion in enumerate(motions):
        columns = [*motion.state[:, :3].T, *motion.modified_input.T]
        for panel, column in zip(axes, columns, strict=True):
            panel.plot(motion.time, column, "-o", markersize=3, color=color(index), linewidth=1)
    for panel, label in zip(axes, _LABELS, strict=True):
        panel.set_ylabel(label)
    axes[0].set_title("Offline optimum (points: collocation)")
    axes[-1].set_xlabel("time [s]")
    end = max((motion.time[-1] for motion in motions), default=_SHOWN)
    axes[-1].set_xlim(0.0, min(_SHOWN, end))
    figure.tight_layout()
    return figure
