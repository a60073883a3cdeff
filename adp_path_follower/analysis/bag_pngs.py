"""The figures of analysed bags as PNG files."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from adp_path_follower.analysis.bag_analysis import BagAnalysis
from adp_path_follower.drawing.charts import KINDS, curve_numbers
from adp_path_follower.drawing.figure_style import DISTANCE_SCALES, color, is_dashed
from adp_path_follower.drawing.run_figures import legend_above, save_figures


def draw_bags(analyses: Sequence[BagAnalysis], directory: FilePath) -> list[FilePath]:
    """Draw the figures of one or several bags; return the files."""
    charts = [analysis.charts for analysis in analyses]
    panels = dict.fromkeys(key for chart in charts for key in chart.panels)
    histograms = dict.fromkeys(key for chart in charts for key in chart.histograms)
    drawings: dict[str, Any] = {"track.png": ((8.0, 6.0), partial(_track, analyses))}
    for key in panels:
        rows = max(len(chart.panels.get(key, ())) for chart in charts)
        size = 9.0, 1.2 + 2.0 * rows
        drawings[f"{key}.png"] = size, partial(_over_time, analyses, key, rows)
    for key in histograms:
        drawings[f"{key}.png"] = (7.0, 3.5), partial(_histogram, analyses, key)
    if any(analysis.events for analysis in analyses):
        drawings["events.png"] = (9.0, 3.0), partial(_events, analyses)
    return save_figures(drawings, directory)


def _plain(text: str) -> str:
    """Return a text in which matplotlib finds no mathematics."""
    return text.replace("$", r"\$")


def _track(analyses: Sequence[BagAnalysis], figure: Figure) -> None:
    axes = figure.subplots()
    for index, analysis in enumerate(analyses):
        track = analysis.charts.track
        axes.plot(*track.path.T, color="0.75", linewidth=4, zorder=1)
        if len(analyses) == 1:
            x, y = track.position.T
            scale = LinearSegmentedColormap.from_list("distance", DISTANCE_SCALES["light"])
            distance, limit = 1e3 * np.abs(track.cross_track), 1e3 * track.color_limit
            dots = axes.scatter(x, y, c=distance, s=5, cmap=scale, vmin=0.0, vmax=limit, zorder=2)
            figure.colorbar(dots, label="|cross-track| [mm]", extend="max")
        else:
            axes.plot(*track.position.T, color=color(index), label=_plain(analysis.name))
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_title("Path and track")
    if len(analyses) > 1:
        legend_above(axes, 1)


def _over_time(analyses: Sequence[BagAnalysis], key: str, rows: int, figure: Figure) -> None:
    axes = figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]
    for index, analysis in enumerate(analyses):
        panels = analysis.charts.panels.get(key, ())
        by_line = len(analyses) == 1
        numbers = curve_numbers(panels) if by_line else {}
        for panel, place in zip(panels, axes, strict=False):
            for line in panel.lines:
                number = numbers.get(line.name, index)
                place.plot(
                    line.time,
                    line.values,
                    color="0.8" if line.background else color(number),
                    linewidth=0.5 if line.background else 1.2,
                    linestyle="--"
                    if by_line and is_dashed(number) and not line.background
                    else "-",
                    drawstyle="steps-post" if panel.steps else None,
                    label=None if line.background else _plain(line.name),
                )
            if panel.span is not None and by_line:
                place.set_ylim(panel.span)
            for limit in filter(np.isfinite, panel.limits):
                place.axhline(limit, color="0.5", linestyle="--", linewidth=0.8)
            place.set_ylabel(panel.label)
            if panel.logarithmic:
                place.set_yscale("log")
            for spans in analysis.charts.halts.values():
                for begin, end in spans:
                    place.axvspan(begin, end, color="0.5", alpha=0.15, linewidth=0)
            if by_line and sum(not line.background for line in panel.lines) > 1:
                place.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7)
    if len(analyses) > 1:
        for index, analysis in enumerate(analyses):
            axes[0].plot([], [], color=color(index), label=_plain(analysis.name))
        handles, labels = axes[0].get_legend_handles_labels()
        count = len(analyses)
        legend_above(axes[0], 1, handles[-count:], labels[-count:])
    axes[-1].set_xlabel("time [s]")


def _histogram(analyses: Sequence[BagAnalysis], key: str, figure: Figure) -> None:
    axes = figure.subplots()
    for index, analysis in enumerate(analyses):
        found = analysis.charts.histograms.get(key)
        if found is not None:
            axes.stairs(
                found.counts,
                found.edges,
                fill=len(analyses) == 1,
                color=color(index),
                label=_plain(analysis.name),
            )
            axes.set_xlabel(found.label)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.5)  # so that what was there once is seen beside what was always there
    axes.set_ylabel("how often")
    if len(analyses) > 1:
        legend_above(axes, 1)


def _events(analyses: Sequence[BagAnalysis], figure: Figure) -> None:
    axes = figure.subplots()
    for index, analysis in enumerate(analyses):
        times = [event.time for event in analysis.events]
        rows = [KINDS.index(event.kind) for event in analysis.events]
        axes.plot(times, rows, "o", color=color(index), label=_plain(analysis.name))
    axes.set_yticks(range(len(KINDS)), KINDS)
    axes.set_ylim(len(KINDS) - 0.5, -0.5)  # the first kind on top
    axes.set_xlabel("time [s]")
    if len(analyses) > 1:
        legend_above(axes, 1)
