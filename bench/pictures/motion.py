"""Drive squares with rounded corners under limits: the table and the figure of docs/paths.md.

python bench/pictures/motion.py [--figure FILE.png]
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path as FilePath

import matplotlib.pyplot as plt
import numpy as np

from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import FloatArray, advance_pose
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.drawing.figure_style import COLORS, STYLE

SIDE = 3.0  # [m]
LIMITS = {
    "max_linear_accel": 1.0,
    "max_linear_decel": 1.0,
    "max_angular_accel": 3.2,
    "max_angular_vel": 1.8,
}
_PERIOD = 0.01  # [s]
_CORNERS = np.array([[0.0, 0.0], [SIDE, 0.0], [SIDE, SIDE], [0.0, SIDE]])


def rounded_square(radius: float) -> Path:
    """Return the square whose corners are quarters of a circle."""
    points = []
    for corner, start in enumerate(_CORNERS):
        heading = 0.5 * math.pi * corner
        ahead = np.array([math.cos(heading), math.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        centre = start + (SIDE - radius) * ahead + radius * left
        straight = np.linspace(radius, SIDE - radius, 140)[:-1]
        angles = np.linspace(0.0, 0.5 * math.pi, max(7, math.ceil(80 * radius)))[:-1]
        points += [start + along * ahead for along in straight]
        points += [centre + radius * (math.sin(a) * ahead - math.cos(a) * left) for a in angles]
    return Path.from_points(points, closed=True)


def drive(path: Path, seconds: float) -> tuple[PathFollower, FloatArray, FloatArray]:
    """Return the follower, and x, y and s_p, y, v, w at each step, shape (N, 2) and (N, 4)."""
    follower = PathFollower(build(Settings, LIMITS), path, 0.0)
    pose, places, rows = path.frame(0.0).pose, [], []
    for _ in range(round(seconds / _PERIOD)):
        output = follower.step(pose, _PERIOD)
        places.append(pose[:2])
        rows.append([float(output.arc_length), float(output.error[1]), *output.command])
        pose = advance_pose(pose, *output.command, _PERIOD)
    return follower, np.array(places), np.array(rows)


def from_the_sides(places: FloatArray) -> float:
    """Return the greatest distance of places (N, 2) from the sides of the sharp square [m]."""
    over = np.maximum(np.maximum(-places, places - SIDE), 0.0)
    outside = np.hypot(over[:, 0], over[:, 1])
    inside = np.minimum(places, SIDE - places).min(axis=1)
    return float(np.where(outside > 0.0, outside, inside).max())


def draw(follower: PathFollower, rows: FloatArray, file: FilePath) -> None:
    """Draw planned and driven speed, and the angular velocity, over the first two corners."""
    with plt.rc_context(STYLE):
        figure, (upper, lower) = plt.subplots(2, sharex=True, figsize=(5.0, 4.5))
        place = np.linspace(0.0, 6.5, 2000)
        planned = np.broadcast_to(follower.profile.speed(place), place.shape)
        shown = rows[rows[:, 0] <= place[-1]]
        upper.plot(place, planned, color=COLORS[1], label="planned, v_des(s_p)", linewidth=3.0)
        upper.plot(shown[:, 0], shown[:, 2], color=COLORS[0], label="driven", linewidth=1.0)
        upper.set_ylabel("v [m/s]")
        upper.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
        turning = planned * follower.path.curvature(place)
        lower.plot(place, turning, color=COLORS[1], label="planned, κ v_des", linewidth=3.0)
        lower.plot(shown[:, 0], shown[:, 3], color=COLORS[0], label="driven", linewidth=1.0)
        lower.set_ylabel("ω [rad/s]")
        lower.set_xlabel("arc length [m]")
        figure.tight_layout()
        figure.savefig(file)


def main() -> None:
    """Print the table, and draw the figure if asked."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--figure", type=FilePath, help="write planned and driven speed here")
    arguments = parser.parse_args()
    for radius in (0.05, 0.1, 0.12, 0.14, 0.15, 0.3):
        path = rounded_square(radius)
        follower, places, rows = drive(path, 35.0)
        slowest = np.min(follower.profile.speed(np.linspace(0.0, path.length, 5000)))
        corners = max(np.hypot(*(places - corner).T).min() for corner in _CORNERS[1:])
        changes = np.abs(np.diff(rows[:, 2:], axis=0)).max(axis=0) / _PERIOD
        print(
            f"r = {radius:.2f} m: slowest {slowest:.3f} m/s, from the sides "
            f"{100 * from_the_sides(places):.2f} cm, from the corners {100 * corners:.2f} cm, "
            f"from the rounded path {100 * np.abs(rows[:, 1]).max():.2f} cm, accelerations "
            f"{changes[0]:.2f} m/s², {changes[1]:.2f} rad/s²"
        )
        if radius == 0.14 and arguments.figure is not None:
            draw(follower, rows, arguments.figure)


if __name__ == "__main__":
    main()
