"""Draw the pictures of docs/tuning.md: `python bench/tuning.py [FOLDER]`, about a minute."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from adp_path_follower.analysis.style import COLORS, STYLE
from adp_path_follower.core.path_library import named_path
from adp_path_follower.core.schema import build
from adp_path_follower.core.settings import Settings
from adp_path_follower.simulation import simulate
from adp_path_follower.trajectories import Trajectories
from sim_unicycle.settings import PlantSettings

_SLOW_ROBOT: dict[str, object] = {"max_linear_vel": 0.6, "max_angular_vel": 1.5}


def run(
    path: str,
    start: tuple[float, float, float],
    duration: float,
    plant: PlantSettings | None = None,
    **values: object,
) -> Trajectories:
    """Return one run, learned before the start."""
    result = simulate(
        build(Settings, values),
        named_path(path),
        start,
        duration=duration,
        learning="warm",
        plant=plant,
        record=True,
    )
    assert result.trajectories is not None  # they were asked for
    return result.trajectories


def _pair(left: str, right: str) -> tuple[Figure, Axes, Axes]:
    figure = Figure(figsize=(8.0, 2.8))
    first, second = figure.subplots(1, 2)
    first.set_title(left)
    second.set_title(right)
    return figure, first, second


def lateral_cost() -> Figure:
    """Show how the cost of y decides how the robot comes back."""
    figure, track, steering = _pair("way back to the path", "what it takes")
    for color, weight in zip(COLORS, (0.3, 1.0, 10.0), strict=False):
        found = run("line", (0.0, 0.5, 0.0), 8.0, state_cost=[1.0, weight, 1.0])
        x, y, _ = found.pose[0].T
        track.plot(x, y, color=color, label=f"y costs {weight:g}")
        steering.plot(found.time, found.command[0, :, 1], color=color)
    track.set(xlabel="x [m]", ylabel="y [m]")
    track.legend(title="state_cost")
    steering.set(xlabel="time [s]", ylabel="ω [rad/s]")
    return figure


def steering_cost() -> Figure:
    """Show how the cost of the angular velocity calms the steering."""
    figure, steering, error = _pair("steering", "heading error")
    for color, weight in zip(COLORS, (0.3, 1.0, 5.0), strict=False):
        found = run("line", (0.0, 0.3, 0.8), 6.0, input_cost=[1.0, weight])
        steering.plot(found.time, found.command[0, :, 1], color=color, label=f"ω costs {weight:g}")
        error.plot(found.time, np.degrees(found.error[0, :, 2]), color=color)
    steering.set(xlabel="time [s]", ylabel="ω [rad/s]")
    steering.legend(title="input_cost")
    error.set(xlabel="time [s]", ylabel="θ [°]")
    return figure


def target_gain() -> Figure:
    """Show whether the target waits for a robot that is behind."""
    figure, behind, speed = _pair("distance to the target", "speed of the robot")
    for color, gain in zip(COLORS, (0.02, 0.1, 1.0), strict=False):
        found = run("line", (-1.0, 0.0, 0.0), 8.0, target_gain=gain)
        behind.plot(found.time, found.error[0, :, 0], color=color, label=f"{gain:g} 1/s")
        speed.plot(found.time, found.command[0, :, 0], color=color)
    behind.set(xlabel="time [s]", ylabel="s [m]")
    behind.legend(title="target_gain")
    speed.set(xlabel="time [s]", ylabel="v [m/s]")
    return figure


def approach_angle() -> Figure:
    """Show how steeply the robot comes from far away."""
    figure = Figure(figsize=(8.0, 3.0))
    axes = figure.subplots()
    axes.axhline(0.0, color="black", linewidth=1.0, label="path")
    for color, angle in zip(COLORS, (0.5, 1.2, 1.5), strict=False):
        found = run("line", (0.0, 4.0, 0.0), 30.0, approach_angle=angle, **_SLOW_ROBOT)
        x, y, _ = found.pose[0].T
        near = x < 12.0
        axes.plot(x[near], y[near], color=color, label=f"{angle:g} rad")
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="way from 4 m beside the path")
    axes.legend(title="approach_angle", loc="upper right")
    return figure


def actuation_delay() -> Figure:
    """Show what it helps to know the delay."""
    figure, error, steering = _pair("a robot that answers 0.3 s late", "steering")
    plant = PlantSettings(command_delay=0.3)
    for color, delay in zip(COLORS, (0.0, 0.3), strict=False):
        found = run(
            "line", (0.0, 0.3, 0.0), 8.0, plant, actuation_delay=delay, state_cost=[1.0, 10.0, 1.0]
        )
        x, y, _ = found.pose[0].T
        error.plot(x, y, color=color, label=f"{delay:g} s")
        steering.plot(found.time, found.command[0, :, 1], color=color)
    error.set(xlabel="x [m]", ylabel="y [m]")
    error.legend(title="actuation_delay")
    steering.set(xlabel="time [s]", ylabel="ω [rad/s]")
    return figure


def lateral_acceleration() -> Figure:
    """Show how the robot brakes before a bend."""
    figure, speed, felt = _pair(
        "through the first bend of the figure eight", "what the robot feels"
    )
    for color, most in zip(COLORS, (np.inf, 0.2, 0.1), strict=False):
        limits = {} if np.isinf(most) else {"max_linear_accel": 0.5, "max_linear_decel": 0.5}
        found = run("lissajous", (0.0, 0.0, 0.0), 50.0, max_lateral_accel=most, **limits)
        command, place = found.command[0], found.arc_length[0]
        near = (place > 10.0) & (place < 22.0)
        label = "∞ (default)" if np.isinf(most) else f"{most:g} m/s²"
        speed.plot(place[near], command[near, 0], color=color, label=label)
        felt.plot(place[near], np.abs(command[near].prod(axis=1)), color=color)
    speed.set(xlabel="place on the path [m]", ylabel="v [m/s]", ylim=(0.0, 0.6))
    speed.legend(title="max_lateral_accel")
    felt.set(xlabel="place on the path [m]", ylabel="|v ω| [m/s²]")
    return figure


PICTURES: dict[str, Callable[[], Figure]] = {
    "lateral_cost": lateral_cost,
    "steering_cost": steering_cost,
    "target_gain": target_gain,
    "approach_angle": approach_angle,
    "actuation_delay": actuation_delay,
    "lateral_acceleration": lateral_acceleration,
}


def main() -> None:
    """Draw every picture."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images")
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        for name, draw in PICTURES.items():
            figure = draw()
            figure.tight_layout()
            figure.savefig(folder / f"tuning_{name}.png", bbox_inches="tight")
            print(folder / f"tuning_{name}.png", flush=True)


if __name__ == "__main__":
    main()
