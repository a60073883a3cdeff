"""The paper's figures 2 to 5 from a run."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from adp_path_follower.analysis.metrics import PaperOptimum
from adp_path_follower.analysis.style import COLORS, STYLE
from adp_path_follower.bags.reader import Run, Series
from adp_path_follower.bags.replay import Replay
from adp_path_follower.core.geometry import FloatArray


def draw_figures(
    run: Run, replay: Replay, directory: Path, optimum: PaperOptimum | None = None
) -> list[Path]:
    """Draw the paper's figures of a run; return the PNG files.

    Args:
        run: The recorded run.
        replay: Its replay, for errors and inputs at each control step.
        directory: Where the files go; made if it is missing.
        optimum: The offline optimum to mark by circles, as in the paper.

    """
    directory.mkdir(parents=True, exist_ok=True)
    time = (replay.stamp - replay.stamp[0]) * 1e-9
    drawings = {
        "figure_2_path.png": lambda: _path(run, replay),
        "figure_3_states.png": lambda: _states(replay, time, optimum),
        "figure_4_controls.png": lambda: _controls(replay, time, optimum),
        "figure_5_weights.png": lambda: _weights(run, replay.stamp[0]),
    }
    files = []
    with mpl.rc_context(STYLE):
        for name, draw in drawings.items():
            files.append(directory / name)
            draw().savefig(files[-1], bbox_inches="tight")
    return files


def _path(run: Run, replay: Replay) -> Figure:
    figure = Figure(figsize=(9.0, 6.0))
    wide, near = figure.subplots(1, 2, width_ratios=[1.0, 1.2])
    path = replay.follower.path.points(0.05)
    target = np.array([output.target_pose for output in replay.outputs])
    track = replay.odometry
    for axes in (wide, near):
        axes.plot(path[:, 0], path[:, 1], color="0.6", linewidth=3, label="path")
        axes.plot(track[:, 0], track[:, 1], color=COLORS[0], linewidth=1.5, label="robot")
        axes.set_aspect("equal")
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
    wide.plot(*track[0, :2], "o", color=COLORS[1], label="start")
    wide.plot(*track[-1, :2], "s", color=COLORS[2], label="end")
    wide.legend(loc="upper left", fontsize=8)
    wide.set_title("Path and robot")
    # The first seconds decide the cost, and are too small to see in the whole.
    near.plot(target[:, 0], target[:, 1], ":", color=COLORS[1], label="virtual target")
    steps = len(track)
    arrows = slice(0, min(steps, 800), 100)
    near.quiver(
        track[arrows, 0],
        track[arrows, 1],
        np.cos(track[arrows, 2]),
        np.sin(track[arrows, 2]),
        color=COLORS[0],
        angles="xy",
        scale_units="xy",
        scale=4.0,
        width=0.008,
        zorder=3,
    )
    low = np.minimum(track[:800, :2].min(axis=0), target[:800, :2].min(axis=0)) - 0.3
    high = np.maximum(track[:800, :2].max(axis=0), target[:800, :2].max(axis=0)) + 0.3
    near.set_xlim(low[0], high[0])
    near.set_ylim(low[1], high[1])
    near.legend(loc="upper left", fontsize=8)
    near.set_title("The start (an arrow every second)")
    figure.tight_layout()
    return figure


def _states(replay: Replay, time: FloatArray, optimum: PaperOptimum | None) -> Figure:
    error = np.array([output.error for output in replay.outputs])
    labels = ("s [m]", "y [m]", "θ [rad]")
    return _against_optimum(
        "Errors to the virtual target",
        labels,
        time,
        error,
        None if optimum is None else (optimum.time, optimum.error),
    )


def _controls(replay: Replay, time: FloatArray, optimum: PaperOptimum | None) -> Figure:
    inputs = np.array([output.modified_input for output in replay.outputs])
    labels = ("v_e = v − v_ss [m/s]", "ω_e = ω − ω_ss [rad/s]")
    return _against_optimum(
        "Inputs beside the feedforward",
        labels,
        time,
        inputs,
        None if optimum is None else (optimum.time, optimum.modified_input),
    )


def _against_optimum(
    title: str,
    labels: tuple[str, ...],
    time: FloatArray,
    values: FloatArray,
    optimum: tuple[FloatArray, FloatArray] | None,
) -> Figure:
    """Draw columns over time: the transient on the left, the whole run on the right."""
    figure = Figure(figsize=(9.0, 4.5))
    early, whole = figure.subplots(1, 2, width_ratios=[1.4, 1.0])
    for column, label in enumerate(labels):
        for axes in (early, whole):
            axes.plot(time, values[:, column], color=COLORS[column], label=label)
        if optimum is not None:
            early.plot(
                optimum[0],
                optimum[1][:, column],
                "o",
                markerfacecolor="none",
                color=COLORS[column],
            )
    if optimum is not None:
        early.plot([], [], "o", markerfacecolor="none", color="0.3", label="offline optimum")
    early.set_xlim(0.0, min(15.0, float(time[-1])))
    early.set_title(title)
    early.legend()
    whole.set_title("whole run (logarithmic beyond ±0.001)")
    # After the transient the errors are thousands of times smaller: a scale that shows both.
    whole.set_yscale("symlog", linthresh=1e-3, linscale=0.5)
    for axes in (early, whole):
        axes.set_xlabel("time [s]")
    figure.tight_layout()
    return figure


def _weights(run: Run, start: int) -> Figure:
    figure = Figure(figsize=(9.0, 4.5))
    pair = figure.subplots(1, 2, sharey=True)
    for axes, name in zip(pair, ("critic_weights", "actor_weights"), strict=True):
        series = run.series.get(name, Series(np.zeros(0, dtype=np.int64), np.zeros((0, 0))))
        time = (series.stamp - start) * 1e-9
        for column in range(series.values.shape[1]):
            axes.plot(
                time,
                series.values[:, column],
                color=COLORS[column % len(COLORS)],
                linestyle="-" if column < len(COLORS) else "--",
                label=series.labels[column],
            )
        axes.set_title(name.replace("_", " ").capitalize())
        axes.set_xlabel("time [s]")
    pair[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), title="term of σ")
    figure.tight_layout()
    return figure
