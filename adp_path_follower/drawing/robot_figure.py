"""Measured velocities beside those of a robot's model."""

from collections.abc import Sequence
from pathlib import Path as FilePath

import numpy as np
from matplotlib.figure import Figure

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.drawing.charts import extremes
from adp_path_follower.drawing.figure_style import COLORS
from adp_path_follower.drawing.run_figures import save_figures

_POINTS = 2000  # of a curve
_LABELS = ("v [m/s]", "ω [rad/s]")

# Time [s] (N,), measured v, w (N, 2), and those of the model (N, 2).
Course = tuple[FloatArray, FloatArray, FloatArray]


def draw_robot(courses: Sequence[Course], file: FilePath) -> None:
    """Draw each drive over time, one after the other, and measured against modelled velocities."""
    save_figures({file.name: lambda: _figure(courses)}, file.parent)


def _figure(courses: Sequence[Course]) -> Figure:
    figure = Figure(figsize=(11.0, 6.0))
    panels = figure.subplots(2, 2, width_ratios=[3.0, 1.0])
    for part, ((over_time, scatter), label) in enumerate(zip(panels, _LABELS, strict=True)):
        begin = 0.0
        for time, measured, model in courses:
            drawn = begin + time - time[0]
            begin = float(drawn[-1]) + 1.0
            for name, values, shade in (("measured", measured, "0.6"), ("model", model, COLORS[0])):
                kept = extremes(values[:, part], _POINTS)
                over_time.plot(drawn[kept], values[kept, part], color=shade, label=name)
            scatter.plot(model[:, part], measured[:, part], ".", color=COLORS[0], markersize=2)
        reach = np.concatenate([model[:, part] for _, _, model in courses])
        ends = [float(reach.min()), float(reach.max())]
        scatter.plot(ends, ends, color="0.4", linewidth=1)
        over_time.set_ylabel(label)
        scatter.set_xlabel(f"model: {label}")
        scatter.set_ylabel("measured")
    names, lines = panels[0, 0].get_legend_handles_labels()
    panels[0, 0].legend(names[:2], lines[:2], loc="upper right")
    panels[1, 0].set_xlabel("time [s]")
    figure.tight_layout()
    return figure
