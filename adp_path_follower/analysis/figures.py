"""The paper's figures 2 to 5 of a run, recorded or simulated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from adp_path_follower.analysis.style import COLORS, STYLE
from adp_path_follower.bags.columns import Series
from adp_path_follower.bags.reader import Run
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path as FollowedPath
from adp_path_follower.study.optimum.reference import ReferenceMotion
from adp_path_follower.study.replay.replay import Replay
from adp_path_follower.study.simulation.trajectories import Trajectories

_TRANSIENT = 15.0  # [s] that the left panels show
_START = 8.0  # [s] that the close-up of the path shows


@dataclass(frozen=True)
class RunView:
    """What the figures show of a run.

    Attributes:
        time: Time of each control step [s], shape (T,).
        path: Positions along the path, shape (P, 2).
        track: x, y, theta of the robot, shape (T, 3).
        target: x, y of the virtual target, shape (T, 2).
        error: e, shape (T, 3).
        modified_input: u, shape (T, 2).
        weight_time: Time of each row of the weights [s], shape (W,).
        critic_weights: Shape (W, L).
        actor_weights: Shape (W, L).
        labels: Names of the terms of the basis, length L.

    """

    time: FloatArray
    path: FloatArray
    track: FloatArray
    target: FloatArray
    error: FloatArray
    modified_input: FloatArray
    weight_time: FloatArray
    critic_weights: FloatArray
    actor_weights: FloatArray
    labels: tuple[str, ...]


def view_of_replay(run: Run, replay: Replay) -> RunView:
    """Return the view of a recorded run: its weights as recorded, the rest as replayed."""
    start = replay.stamp[0]
    nothing = Series(np.zeros(0, dtype=np.int64), np.zeros((0, 0)))
    critic = run.series.get("critic_weights", nothing)
    actor = run.series.get("actor_weights", nothing)
    count = min(len(critic.stamp), len(actor.stamp))
    time = (replay.stamp - start) * 1e-9
    # Weights carry no stamp. With one message for each step they belong to the steps in order;
    # else the time of their arrival, which lags, must do.
    every_step = count == len(time)
    return RunView(
        time=time,
        path=replay.follower.path.points(0.05)[:, :2],
        track=replay.pose,
        target=np.array([output.target_pose[:2] for output in replay.outputs]),
        error=np.array([output.error for output in replay.outputs]),
        modified_input=np.array([output.modified_input for output in replay.outputs]),
        weight_time=time if every_step else (critic.stamp[:count] - start) * 1e-9,
        critic_weights=critic.values[:count],
        actor_weights=actor.values[:count],
        labels=critic.labels,
    )


def view_of_simulation(
    trajectories: Trajectories, run: int, path: FollowedPath, labels: tuple[str, ...]
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


def draw_figures(
    view: RunView, directory: Path, optimum: ReferenceMotion | None = None
) -> list[Path]:
    """Draw the paper's figures of a run; return the PNG files.

    Args:
        view: The run.
        directory: Where the files go; made if it is missing.
        optimum: The offline optimum to mark by circles, as in the paper.

    """
    drawings = {
        "figure_2_path.png": lambda: _path(view, optimum),
        "figure_3_states.png": lambda: _against_optimum(
            "Errors to the virtual target",
            ("s [m]", "y [m]", "θ [rad]"),
            view.time,
            view.error,
            None if optimum is None else (optimum.time, optimum.error),
        ),
        "figure_4_controls.png": lambda: _against_optimum(
            "Inputs beside the feedforward",
            ("v_e = v − v_ss [m/s]", "ω_e = ω − ω_ss [rad/s]"),
            view.time,
            view.modified_input,
            None if optimum is None else (optimum.time, optimum.modified_input),
        ),
        "figure_5_weights.png": lambda: _weights(view),
    }
    directory.mkdir(parents=True, exist_ok=True)
    files = []
    with mpl.rc_context(STYLE):
        for name, draw in drawings.items():
            files.append(directory / name)
            draw().savefig(files[-1], bbox_inches="tight")
    return files


def _path(view: RunView, optimum: ReferenceMotion | None) -> Figure:
    figure = Figure(figsize=(9.0, 6.0))
    wide, near = figure.subplots(1, 2, width_ratios=[1.0, 1.2])
    for axes in (wide, near):
        axes.plot(*view.path.T, color="0.6", linewidth=3, label="path")
        axes.plot(*view.track[:, :2].T, color=COLORS[0], linewidth=1.5, label="robot")
        axes.set_aspect("equal")
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
    wide.plot(*view.track[0, :2], "o", color=COLORS[1], label="start")
    wide.plot(*view.track[-1, :2], "s", color=COLORS[2], label="end")
    wide.legend(loc="upper left", fontsize=8)
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
    near.legend(loc="upper left", fontsize=8)
    near.set_title("The start (an arrow every second)")
    figure.tight_layout()
    return figure


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
    circles: dict[str, Any] = {"marker": "o", "linestyle": "none", "markerfacecolor": "none"}
    for column, label in enumerate(labels):
        for axes in (early, whole):
            axes.plot(time, values[:, column], color=COLORS[column], label=label)
        if optimum is not None:
            early.plot(optimum[0], optimum[1][:, column], color=COLORS[column], **circles)
    if optimum is not None:
        early.plot([], [], color="0.3", label="offline optimum", **circles)
    early.set_xlim(0.0, min(_TRANSIENT, float(time[-1])))
    early.set_title(title)
    early.legend()
    whole.set_title("whole run (logarithmic beyond ±0.001)")
    # After the transient the errors are thousands of times smaller: a scale that shows both.
    whole.set_yscale("symlog", linthresh=1e-3, linscale=0.5)
    for axes in (early, whole):
        axes.set_xlabel("time [s]")
    figure.tight_layout()
    return figure


def _weights(view: RunView) -> Figure:
    figure = Figure(figsize=(9.0, 4.5))
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
    if len(named) < len(view.labels):
        pair[1].plot([], [], color="0.75", label=f"{len(view.labels) - len(named)} others")
    pair[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), title="term of σ")
    figure.tight_layout()
    return figure


def _named_terms(view: RunView) -> list[int]:
    """Return the terms that get a colour and a name: all of a few, the largest of many."""
    if len(view.labels) <= 2 * len(COLORS) or not len(view.critic_weights):
        return list(range(len(view.labels)))
    size = np.abs(view.critic_weights).max(axis=0)
    return sorted(np.argsort(-size)[: 2 * len(COLORS) - 4].tolist())


def draw_replay(replay: Replay, file: Path) -> None:
    """Draw recorded and replayed commands over time."""
    time = (replay.stamp - replay.stamp[0]) * 1e-9
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 5.0))
        panels = figure.subplots(2, 1, sharex=True)
        for column, (axes, label) in enumerate(zip(panels, ("v [m/s]", "ω [rad/s]"), strict=True)):
            axes.plot(time, replay.recorded[:, column], color="0.6", linewidth=3, label="recorded")
            axes.plot(time, replay.replayed[:, column], color=COLORS[1], label="replayed")
            axes.set_ylabel(label)
        panels[0].set_title("Commands to the recorded odometry")
        panels[0].legend()
        panels[1].set_xlabel("time [s]")
        figure.savefig(file, bbox_inches="tight")
