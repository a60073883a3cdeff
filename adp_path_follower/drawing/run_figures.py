"""Pictures that matplotlib draws: the paper's figures 2 to 5, and quick looks at results."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path as FilePath
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.drawing.charts import ReferenceMotion, RunView, Track, line_of
from adp_path_follower.drawing.figure_style import COLORS, STYLE

_POINTS = 2000  # of a curve
_LABELS = ("v [m/s]", "ω [rad/s]")

# Name of a file -> size of its figure [inch], and what draws it.
Drawings = Mapping[str, tuple[tuple[float, float], Callable[[Figure], None]]]
# Time [s] (N,), measured v, w (N, 2), and those of the model (N, 2).
Course = tuple[FloatArray, FloatArray, FloatArray]


def draw_robot(courses: Sequence[Course], file: FilePath) -> None:
    """Draw each drive over time, one after the other, and measured against modelled velocities."""
    save_figures({file.name: ((11.0, 6.0), partial(_robot, courses))}, file.parent)


def _robot(courses: Sequence[Course], figure: Figure) -> None:
    panels = figure.subplots(2, 2, width_ratios=[3.0, 1.0])
    for part, ((over_time, scatter), label) in enumerate(zip(panels, _LABELS, strict=True)):
        begin = 0.0
        for time, measured, model in courses:
            drawn = begin + time - time[0]
            begin = float(drawn[-1]) + 1.0
            for name, values, style in (
                ("measured", measured, {"color": "0.6", "linewidth": 4.0}),  # seen beside the model
                ("model", model, {"color": COLORS[0]}),
            ):
                line = line_of(name, drawn, values[:, part], _POINTS)
                over_time.plot(line.time, line.values, label=name, **style)
            scatter.plot(model[:, part], measured[:, part], ".", color=COLORS[0], markersize=2)
        reach = np.concatenate([model[:, part] for _, _, model in courses])
        ends = [float(reach.min()), float(reach.max())]
        scatter.plot(ends, ends, color="0.4", linewidth=1)
        over_time.set_ylabel(label)
        scatter.set_xlabel(f"model: {label}")
        scatter.set_ylabel(f"measured: {label}")
    names, lines = panels[0, 0].get_legend_handles_labels()
    legend_above(panels[0, 0], 2, names[:2], lines[:2])
    panels[1, 0].set_xlabel("time [s]")
    figure.tight_layout()


def draw_over_time(
    file: FilePath,
    title: str,
    labels: Sequence[str],
    curves: Sequence[tuple[FloatArray, FloatArray, dict[str, Any]]],
    until: float = math.inf,
) -> None:
    """Draw curves over time until a time [s], each column in a panel of its own.

    A curve has times [s] (N,), values (N, number of labels), and how matplotlib draws it.
    """

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(labels), 1, sharex=True)
        for time, values, style in curves:
            for axes, column in zip(panels, values.T, strict=True):
                axes.plot(time, column, **style)
        for axes, label in zip(panels, labels, strict=True):
            axes.set_ylabel(label)
        panels[0].set_title(title)
        if panels[0].get_legend_handles_labels()[1]:
            legend_above(panels[0])
        panels[-1].set_xlabel("time [s]")
        if math.isfinite(until):
            end = max((float(time[-1]) for time, *_ in curves), default=until)
            panels[-1].set_xlim(0.0, min(until, end))
        figure.tight_layout()

    save_figures({file.name: ((9.0, (11 + 2 * len(labels)) / 3), draw)}, file.parent)


def plotted(draw: Callable[[Axes], None], axes: Axes | None) -> Axes:
    """Draw on axes, or on those of a new figure of pyplot; return them."""
    if axes is None:  # outside the context, which would undo that notebooks show its figures
        import matplotlib.pyplot as plt

        axes = plt.subplots(figsize=(7.0, 4.0), dpi=STYLE["figure.dpi"], layout="constrained")[1]
    with mpl.rc_context(STYLE):
        draw(axes)
    axes.grid(visible=True, alpha=STYLE["grid.alpha"])
    axes.spines[["top", "right"]].set_visible(False)
    return axes


def draw_errors(axes: Axes, time: FloatArray, error: FloatArray) -> None:
    """Draw e = [s, y, theta], shape (T, 3), over time [s], shape (T,)."""
    for column, label in enumerate(("s [m]", "y [m]", "θ [rad]")):
        axes.plot(time, error[:, column], color=COLORS[column], label=label)
    axes.set(xlabel="time [s]", ylabel="s, y [m]; θ [rad]")
    axes.set_title("Errors to the virtual target")
    legend_above(axes)


def draw_track(axes: Axes, track: Track) -> None:
    """Draw where a robot drove, over its path."""
    axes.plot(*track.path.T, color="0.75", linewidth=4, label="path")
    axes.plot(*track.position.T, color=COLORS[0], label="robot")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_title("Path and track")
    legend_above(axes)


def legend_above(axes: Axes, columns: int = 3, *content: Any) -> None:
    """Put a legend above axes, where it is on no curve, and their title above it."""
    place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2}
    legend = axes.legend(*content, ncols=columns, **place)
    rows = -(-len(legend.get_texts()) // columns)
    axes.set_title(axes.get_title(), pad=10.0 + 16.0 * rows)


_EARLY = 15.0  # [s] that the left panels show
# A legend below its axes, as a path may lie anywhere in them.
_BELOW: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.1), "ncols": 2}
_START = 8.0  # [s] that the close-up of the path shows


def draw_figures(
    view: RunView, directory: FilePath, optimum: ReferenceMotion | None = None
) -> list[FilePath]:
    """Draw the paper's figures into a directory, the optimum as circles; return the PNG files."""
    against = partial(_against_optimum, view, optimum)
    drawings: Drawings = {
        "figure_2_path.png": ((9.0, 6.0), partial(_path, view, optimum)),
        "figure_3_states.png": ((9.0, 4.5), partial(against, "error")),
        "figure_4_controls.png": ((9.0, 4.5), partial(against, "modified_input")),
        "figure_5_weights.png": ((9.0, 4.5), partial(_weights, view)),
    }
    return save_figures(drawings, directory)


def save_figures(drawings: Drawings, directory: FilePath) -> list[FilePath]:
    """Draw figures by name into a directory, which is made if needed; return their files."""
    directory.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        for name, (size, draw) in drawings.items():
            figure = Figure(figsize=size)
            draw(figure)
            figure.savefig(directory / name, bbox_inches="tight")
    return [directory / name for name in drawings]


def _path(view: RunView, optimum: ReferenceMotion | None, figure: Figure) -> None:
    wide, near = figure.subplots(1, 2, width_ratios=[1.0, 1.2])
    for axes in (wide, near):
        axes.plot(*view.path.T, color="0.6", linewidth=3, label="path")
        axes.plot(*view.track[:, :2].T, color=COLORS[0], linewidth=1.5, label="robot")
        axes.set_aspect("equal")
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
    wide.plot(*view.track[0, :2], "o", color=COLORS[1], label="start")
    wide.plot(*view.track[-1, :2], "s", color=COLORS[2], label="end")
    wide.legend(**_BELOW)
    wide.set_title("Path and robot")
    # The first seconds decide the cost, and are too small to see in the whole.
    early = view.time <= _START
    near.plot(*view.target.T, ":", color=COLORS[1], label="virtual target")
    if optimum is not None and optimum.position is not None:
        near.plot(
            *optimum.position[optimum.time <= _START].T,
            "o",
            color="0.2",
            markersize=4,
            markerfacecolor="none",
            label="offline optimum",
        )
    arrows = np.searchsorted(view.time, np.arange(0.0, min(_START, view.time[-1]), 1.0))
    near.quiver(
        *view.track[arrows, :2].T,
        np.cos(view.track[arrows, 2]),
        np.sin(view.track[arrows, 2]),
        color=COLORS[0],
        angles="xy",
        scale_units="xy",
        scale=4.0,
        width=0.008,
        zorder=3,
    )
    shown = np.vstack([view.track[early, :2], view.target[early]])
    near.set_xlim(shown[:, 0].min() - 0.3, shown[:, 0].max() + 0.3)
    near.set_ylim(shown[:, 1].min() - 0.3, shown[:, 1].max() + 0.3)
    near.legend(**_BELOW)
    near.set_title("The start (an arrow every second)")
    figure.tight_layout()


# Column of `RunView` and `ReferenceMotion` -> title, label of the axis, and labels of the curves.
_COLUMNS = {
    "error": ("Errors to the virtual target", "s, y [m]; θ [rad]", ("s [m]", "y [m]", "θ [rad]")),
    "modified_input": (
        "Inputs beside the feedforward",
        "v_e [m/s], ω_e [rad/s]",
        ("v_e = v − v_ss [m/s]", "ω_e = ω − ω_ss [rad/s]"),
    ),
}


def _against_optimum(
    view: RunView, optimum: ReferenceMotion | None, name: str, figure: Figure
) -> None:
    """Draw a value over time: the first seconds on the left, the whole run on the right."""
    early, whole = figure.subplots(1, 2, width_ratios=[1.4, 1.0])
    title, axis, labels = _COLUMNS[name]
    time, values = view.time, getattr(view, name)
    circles: dict[str, Any] = {"marker": "o", "linestyle": "none", "markerfacecolor": "none"}
    for column, label in enumerate(labels):
        for axes in (early, whole):
            axes.plot(time, values[:, column], color=COLORS[column], label=label)
        if optimum is not None:
            best = getattr(optimum, name)[:, column]
            early.plot(optimum.time, best, color=COLORS[column], **circles)
    if optimum is not None:
        early.plot([], [], color="0.3", label="offline optimum", **circles)
    early.set_xlim(0.0, min(_EARLY, float(time[-1])))
    early.set(title=title, ylabel=axis)
    legend_above(early, 2)
    whole.set_title("whole run (logarithmic beyond ±0.001)")
    # Later the errors are thousands of times smaller: a scale that shows both.
    whole.set_yscale("symlog", linthresh=1e-3, linscale=0.5)
    for axes in (early, whole):
        axes.set_xlabel("time [s]")
    figure.tight_layout()


def _weights(view: RunView, figure: Figure) -> None:
    pair = figure.subplots(1, 2, sharey=True)
    both = {"Critic weights": view.critic_weights, "Actor weights": view.actor_weights}
    named = _named_terms(view)
    for axes, (title, weights) in zip(pair, both.items(), strict=True):
        for column in range(len(view.labels)):
            if column not in named:
                axes.plot(view.weight_time, weights[:, column], color="0.75", linewidth=0.6)
        for rank, column in enumerate(named):
            axes.plot(
                view.weight_time,
                weights[:, column],
                color=COLORS[rank % len(COLORS)],
                linestyle="-" if rank < len(COLORS) else "--",
                label=view.labels[column],
            )
        axes.set_title(title)
        axes.set_xlabel("time [s]")
    pair[0].set_ylabel("weight")
    if len(named) < len(view.labels):
        pair[1].plot([], [], color="0.75", label=f"{len(view.labels) - len(named)} others")
    pair[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), title="term of σ")
    figure.tight_layout()


def _named_terms(view: RunView) -> list[int]:
    """Return the terms that get a colour and a name: all of a few, the largest of many."""
    if len(view.labels) <= 2 * len(COLORS) or not len(view.critic_weights):
        return list(range(len(view.labels)))
    size = np.abs(view.critic_weights).max(axis=0)
    return sorted(np.argsort(-size)[: 2 * len(COLORS) - 4].tolist())
