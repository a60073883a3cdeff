"""Draw docs/images/value_map.png: the value function as a map, and ways down it.

A minute or two: python bench/pictures/value_map.py [FILE.png]
"""

from __future__ import annotations

import math
import sys
from pathlib import Path as FilePath

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import adp_path_follower as adp
from adp_path_follower.core.control.value_store import value_grid
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.drawing.figure_style import STYLE

_AXES = {"s": (0, 5.0, "ahead of the target: s [m]"), "y": (1, 5.0, "to the left: y [m]")}
_AXES["theta"] = (2, math.pi, "heading θ [rad]")
_ANGLES = np.linspace(0.0, 2.0 * math.pi, 8, endpoint=False) + 0.2
_RING = 4.0 * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
_HEADINGS = np.linspace(-2.8, 2.8, 5)
# Title, the two axes, what the third variable is, and the starts.
_MAPS = (
    ("facing along the path, θ = 0", "s", "y", 0.0, np.insert(_RING, 2, 0.0, axis=1)),
    ("facing back, θ = π", "s", "y", math.pi, np.insert(_RING, 2, math.pi, axis=1)),
    (
        "beside the target, s = 0",
        "theta",
        "y",
        0.0,
        np.array([[0.0, y, heading] for y in (-4.0, 4.0) for heading in _HEADINGS]),
    ),
)


def main() -> None:
    """Draw the three maps, one below the other."""
    file = FilePath(sys.argv[1] if len(sys.argv) > 1 else "docs/images/value_map.png")
    with mpl.rc_context({**STYLE, "axes.grid": False}):
        figure = Figure(figsize=(5.0, 10.4), layout="constrained")
        for axes, (title, across, up, third, starts) in zip(
            figure.subplots(3, 1), _MAPS, strict=True
        ):
            shades = _draw_value(axes, across, up, third)
            _draw_ways(axes, across, up, starts)
            axes.set_title(title)
        label = "√V, the root of the cost to come"
        figure.colorbar(shades, ax=figure.axes, label=label, location="bottom", aspect=30)
        figure.axes[0].legend(loc="upper left", labelcolor="white")
        figure.savefig(file)


def _draw_value(axes: Axes, across: str, up: str, third: float) -> mpl.contour.QuadContourSet:
    """Draw the root of V on a straight path, with the third variable held."""
    (column, most_across, label_across), (row, most_up, label_up) = _AXES[across], _AXES[up]
    x, y = np.linspace(-most_across, most_across, 241), np.linspace(-most_up, most_up, 241)
    errors = np.full((len(y), len(x), 3), third)
    errors[..., column], errors[..., row] = x, y[:, None]
    value, _ = value_grid(adp.load_settings()).value_and_slope(errors, np.zeros(errors.shape[:2]))
    axes.set_xlabel(label_across)
    axes.set_ylabel(label_up)
    return axes.contourf(x, y, np.sqrt(value), levels=np.linspace(0.0, 14.0, 29), cmap="viridis")


def _draw_ways(axes: Axes, across: str, up: str, starts: FloatArray) -> None:
    """Draw the optimal ways from the starts, shape (N, 3), and those of the controller."""
    found = adp.simulate("line", starts=starts, learning="warm", duration=25.0, record=True)
    assert found.trajectories is not None
    (column, *_), (row, *_) = _AXES[across], _AXES[up]
    for number, start in enumerate(starts):
        best = adp.optimum("line", "default", start=start).motion.state
        ours = found.trajectories.error[number]
        first = number == 0
        for way, style, name in (
            (best, {"color": "white", "lw": 2.5}, "optimum"),
            (ours, {"color": "black", "lw": 1.0, "ls": "--"}, "controller"),
        ):
            axes.plot(*_unbroken(way, column, row), **style, label=name if first else None)
        axes.plot(start[column], start[row], "o", color="white", ms=4)


def _unbroken(way: FloatArray, column: int, row: int) -> tuple[FloatArray, FloatArray]:
    """Return the two coordinates of a way, with gaps where the heading passes from π to -π."""
    wrapped = way[:, :3].copy()
    wrapped[:, 2] = (wrapped[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
    wrapped[1:][np.abs(np.diff(wrapped[:, 2])) > math.pi] = math.nan
    return wrapped[:, column], wrapped[:, row]


if __name__ == "__main__":
    main()
