"""Draw the pictures of docs/tuning.md: `python bench/pictures/tuning.py [FOLDER]`, one minute."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path as FilePath

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import named_path, path_through
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.drawing.figure_style import COLORS, STYLE
from adp_path_follower.study.simulation.simulate import simulate
from adp_path_follower.study.simulation.trajectories import Trajectories
from sim_unicycle.settings import PlantSettings


def run(
    path: str | Path,
    start: tuple[float, float, float],
    duration: float,
    plant: PlantSettings | None = None,
    **values: object,
) -> Trajectories:
    """Return one run, learned before the start."""
    result = simulate(
        build(Settings, values),
        named_path(path) if isinstance(path, str) else path,
        start,
        duration=duration,
        learning="warm",
        plant=plant,
        record=True,
    )
    assert result.trajectories is not None  # they were asked for
    return result.trajectories


def _pair(upper: str, lower: str) -> tuple[Figure, Axes, Axes]:
    figure = Figure(figsize=(5.0, 5.2))
    first, second = figure.subplots(2, 1)
    first.set_title(upper)
    second.set_title(lower)
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


def actuation_delay() -> Figure:
    """Show the benefit of a known delay."""
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


def accelerations() -> Figure:
    """Show how limits of acceleration change the commands."""
    figure, speed, steering = _pair("from standstill, beside the path", "steering")
    for color, most in zip(COLORS, (np.inf, 0.5, 0.2), strict=False):
        limits: dict[str, object] = {}
        if np.isfinite(most):
            limits = {
                "max_linear_accel": most,
                "max_linear_decel": most,
                "max_angular_accel": 2.0 * most,
            }
        found = run("line", (0.0, 0.3, 0.0), 8.0, **limits)
        label = f"{most:g} m/s², {2.0 * most:g} rad/s²" if limits else "∞ (default)"
        speed.plot(found.time, found.command[0, :, 0], color=color)
        steering.plot(found.time, found.command[0, :, 1], color=color, label=label)
    speed.set(xlabel="time [s]", ylabel="v [m/s]")
    steering.set(xlabel="time [s]", ylabel="ω [rad/s]")
    steering.legend(title="linear, angular accelerations")
    return figure


def path_tolerance() -> Figure:
    """Show how far a corner is cut, and how slow it is taken."""
    figure, track, speed = _pair("a corner", "speed through it")
    side, rest = np.linspace(0.0, 2.0, 21), np.full(21, 2.0)
    poses = np.vstack([np.stack([side, 0.0 * side], 1), np.stack([rest, side], 1)])
    track.plot(*poses.T, color="0.6", linewidth=1.0)
    for color, tolerance in zip(COLORS, (0.02, 0.05, 0.2), strict=False):
        path = path_through(poses, False, PathSettings(path_tolerance=tolerance))
        found = run(
            path,
            (0.0, 0.0, 0.0),
            12.0,
            max_angular_vel=1.5,
            max_linear_accel=0.5,
            max_linear_decel=0.5,
        )
        x, y, _ = found.pose[0].T
        track.plot(x, y, color=color, label=f"{100.0 * tolerance:g} cm")
        # From the corner on, which is in the middle of every one of these paths.
        place = found.arc_length[0] - 0.5 * path.length
        near = np.abs(place) < 1.0
        speed.plot(place[near], found.command[0, near, 0], color=color)
    track.set(xlabel="x [m]", ylabel="y [m]", xlim=(1.3, 2.1), ylim=(-0.1, 0.7), aspect="equal")
    track.legend(title="path_tolerance", loc="upper left")
    speed.set(xlabel="place from the corner [m]", ylabel="v [m/s]", ylim=(0.0, 0.6))
    return figure


def learning() -> Figure:
    """Show how the Riccati policy drives where learning goes wrong: costs a thousandfold."""
    figure, track, steering = _pair("way back to the path", "what it takes")
    costs = {"state_cost": [1e3, 1e3, 1e3], "input_cost": [1e3, 1e3]}
    labels = {1e6: "10⁶: learned", 1e3: "1000: WARN, Riccati"}
    for color, (bound, label) in zip(COLORS, labels.items(), strict=False):
        found = run("line", (-0.5, 0.6, -1.0), 10.0, actor_weight_bound=bound, **costs)
        x, y, _ = found.pose[0].T
        track.plot(x, y, color=color, label=label)
        steering.plot(found.time, found.command[0, :, 1], color=color)
    track.set(xlabel="x [m]", ylabel="y [m]")
    track.legend(title="actor_weight_bound")
    steering.set(xlabel="time [s]", ylabel="ω [rad/s]")
    return figure


PICTURES: dict[str, Callable[[], Figure]] = {
    "lateral_cost": lateral_cost,
    "steering_cost": steering_cost,
    "target_gain": target_gain,
    "actuation_delay": actuation_delay,
    "lateral_acceleration": lateral_acceleration,
    "accelerations": accelerations,
    "path_tolerance": path_tolerance,
    "learning": learning,
}


def main() -> None:
    """Draw every picture."""
    folder = FilePath(sys.argv[1] if len(sys.argv) > 1 else "docs/images")
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        for name, draw in PICTURES.items():
            figure = draw()
            figure.tight_layout()
            figure.savefig(folder / f"tuning_{name}.png", bbox_inches="tight")
            print(folder / f"tuning_{name}.png", flush=True)


if __name__ == "__main__":
    main()
