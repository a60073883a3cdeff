"""Animate the robot beside the offline optimum: docs/images/race.gif, the picture of README.

python bench/pictures/animation.py [FILE.gif]
"""

from __future__ import annotations

import math
import sys
from pathlib import Path as FilePath

import matplotlib as mpl
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure

import adp_path_follower as adp
from adp_path_follower.core.geometry import FloatArray, pose_in_frame
from adp_path_follower.drawing.figure_style import COLORS, STYLE

_SECONDS = 14.0
_FRAMES_A_SECOND = 10
_PATH = "circle:0.5"
_START = (-0.5, -1.0, -1.0)  # beside the circle, and heading away
_UNLIMITED = dict.fromkeys(("max_linear_vel", "max_angular_vel"), math.inf)


def poses() -> dict[str, FloatArray]:
    """Return x, y, heading of each robot in each frame, shape (N, 3), by its name."""
    path = adp.path(_PATH)
    time = np.arange(0.0, _SECONDS, 1.0 / _FRAMES_A_SECOND)
    best = adp.optimum(path, "paper", start=_START)
    motion = np.stack([np.interp(time, best.motion.time, item) for item in best.motion.state.T])
    found = {
        f"offline optimum, J = {best.cost:.4f}": pose_in_frame(
            motion[:3].T, path.frame(motion[3]).pose
        )
    }
    recommended = adp.load_settings("default", min_linear_vel=-math.inf, **_UNLIMITED)
    for name, settings in {"recommended": recommended, "the paper's laws": "paper"}.items():
        run = adp.simulate(path, settings, starts=_START, record=True)
        assert run.trajectories is not None  # record=True
        steps = np.searchsorted(run.trajectories.time, time - 1e-9)
        found[f"{name}, J = {run.cost[0]:.4f}"] = run.trajectories.pose[0, steps]
    return found


def animate(robots: dict[str, FloatArray], file: FilePath) -> None:
    """Draw all robots over the path, frame by frame."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(4.6, 4.8), dpi=90, layout="constrained")
        axes = figure.subplots()
        circle = adp.path(_PATH).points(0.05)[:, :2]
        axes.plot(*circle.T, color="0.85", linewidth=6)
        drawn = []
        for color, (name, pose) in zip(("0.2", *COLORS), robots.items(), strict=False):
            wide = 3.5 if "optimum" in name else 1.5  # so that the one that covers it shows
            (trail,) = axes.plot([], [], color=color, linewidth=wide, label=name)
            (nose,) = axes.plot([], [], color=color, linewidth=5, solid_capstyle="round")
            drawn.append((pose, trail, nose))
        seen = np.vstack([circle, *(pose[:, :2] for pose in robots.values())])
        low, high = seen.min(axis=0) - 0.2, seen.max(axis=0) + 0.2
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
        axes.set_aspect("equal")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14))

        def frame(number: int) -> list:
            axes.set_title(
                f"Back to a circle of 2 m: {number / _FRAMES_A_SECOND:4.1f} s", loc="left"
            )
            for pose, trail, nose in drawn:
                x, y, heading = pose[number]
                trail.set_data(*pose[: number + 1, :2].T)
                ahead = 0.25 * np.array([np.cos(heading), np.sin(heading)])
                nose.set_data([x, x + ahead[0]], [y, y + ahead[1]])
            return [artist for _, *both in drawn for artist in both]

        count = len(next(iter(robots.values())))
        animation = FuncAnimation(figure, frame, frames=count)
        animation.save(file, writer=PillowWriter(fps=_FRAMES_A_SECOND))


if __name__ == "__main__":
    animate(poses(), FilePath(sys.argv[1] if len(sys.argv) > 1 else "docs/images/race.gif"))
