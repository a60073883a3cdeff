"""Plots of results on axes of their reader's, in the style of the other figures."""

from collections.abc import Callable

import matplotlib as mpl
from matplotlib.axes import Axes

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.drawing.charts import Track
from adp_path_follower.drawing.figure_style import COLORS, STYLE


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
    axes.set(xlabel="time [s]", title="Errors to the virtual target")
    axes.legend()


def draw_track(axes: Axes, track: Track) -> None:
    """Draw where a robot drove, over its path."""
    axes.plot(*track.path.T, color="0.75", linewidth=4, label="path")
    axes.plot(*track.position.T, color=COLORS[0], label="robot")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="x [m]", ylabel="y [m]", title="Path and track")
    axes.legend()
