"""Draw docs/images/paths.png: poses, and the routes through them.

python bench/pictures/path_figure.py
"""

from __future__ import annotations

import math
import textwrap
from pathlib import Path as FilePath

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.settings.groups import PathSettings
from adp_path_follower.drawing.figure_style import COLORS, STYLE

_FILE = FilePath(__file__).parents[2] / "docs" / "images" / "paths.png"


def cases() -> dict[str, np.ndarray]:
    """Return poses by the title of their picture."""
    noisy = lissajous().points(0.05)[120:260, :2]
    angles = np.linspace(0.0, math.tau, 13)
    return {
        "a corner of a square of 5 poses": np.array(
            [[0, 0], [3, 0], [3, 3], [0, 3], [0, 0]], float
        ),
        "noise of 1 cm": noisy + np.random.default_rng(0).normal(0.0, 0.01, noisy.shape),
        "there and back, with allow_reversing": np.array(
            [[0.0, 0.0], [1.0, 0.0], [2.0, 0.2], [1.2, 0.6], [0.0, 0.7]]
        ),
        "12 poses on a circle of 1 m": np.stack([np.cos(angles), np.sin(angles)], axis=1),
    }


def main() -> None:
    """Draw the figure."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.0, 5.6), layout="constrained")
        all_axes = figure.subplots(2, 2).ravel()
        for axes, (title, poses) in zip(all_axes, cases().items(), strict=True):
            axes.plot(*poses.T, "o-", color="0.7", markersize=3, linewidth=1.0)
            for segment in prepare(poses, PathSettings(allow_reversing=True)).segments:
                places = segment.path.points(0.005)[:, :2]
                axes.plot(*places.T, color=COLORS[1 if segment.reverse else 0])
            axes.set_title(textwrap.fill(title, 21))
            axes.set_aspect("equal")
            axes.set_xlabel("x [m]")
            axes.set_ylabel("y [m]")
        all_axes[0].set(xlim=(2.5, 3.1), ylim=(-0.1, 0.5))
        all_axes[1].set(xlim=(2.75, 3.25), ylim=(8.1, 8.6))
        figure.savefig(_FILE)


if __name__ == "__main__":
    main()
