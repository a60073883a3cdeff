"""Figures of the comparison with the peers."""

import math
from functools import partial
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from adp_path_follower.drawing.figure_style import COLORS
from adp_path_follower.drawing.run_figures import Drawings, save_figures
from adp_path_follower.study.comparison.compare import Comparison, Outcome

_LEAST_LOSS = 1e-6  # of J*: what is drawn for less, and for less than nothing
_OWN = ("adp", "adp_cold")


def draw_comparison(found: Comparison, directory: FilePath) -> list[FilePath]:
    """Draw cost, cross-track error and computing time of one path; return the PNG files."""
    cost_size = 5.0, 0.5 * len(found.outcomes) + 1.6
    drawings: Drawings = {
        "cost.png": (cost_size, lambda figure: draw_cost(figure.subplots(), found)),
        "cross_track.png": ((9.0, 6.0), partial(_cross_track, found)),
        "cost_per_step.png": ((7.0, 4.5), partial(_cost_per_step, found)),
    }
    return save_figures(drawings, directory)


def _color(name: str) -> str:
    if name in _OWN:
        return COLORS[1]
    return {"nmpc": COLORS[0], "lqr": COLORS[2], "paper": COLORS[3]}.get(name, "0.45")


def draw_cost(axes: Axes, found: Comparison) -> None:
    """Draw each start's loss J/J* - 1, the controllers in the order of their medians."""
    ranked = sorted(found.outcomes, key=lambda outcome: -outcome.quantile(0.5))
    beside = axes.get_yaxis_transform()  # of the axes across, of the data upwards
    random = np.random.default_rng(0)  # of the jitter, so that the same numbers look the same
    for row, outcome in enumerate(ranked):
        loss = np.maximum(outcome.cost_ratio[np.isfinite(outcome.cost_ratio)] - 1.0, _LEAST_LOSS)
        jitter = random.uniform(-0.15, 0.15, len(loss))
        axes.plot(loss, row + jitter, ".", color=_color(outcome.name), alpha=0.5, markersize=5)
        if len(loss):
            axes.plot(np.median(loss), row, "|", color="k", markersize=14, markeredgewidth=2)
        failures = int(outcome.failed.sum())
        if failures:
            axes.text(1.0, row, f"{failures} failed", ha="right", va="center", transform=beside)
        axes.text(0.01, row + 0.27, outcome.name, transform=beside)  # beside them is no room
    axes.set_yticks(range(len(ranked)), [])
    axes.set_ylim(-0.5, len(ranked) - 0.3)  # those of whom nothing is drawn, too
    _logarithmic(axes, x=any(np.isfinite(outcome.cost_ratio).any() for outcome in ranked))
    axes.set_xlabel("loss J/J* − 1 of each start (bar: median)")
    axes.set_title(
        f"Cost beside the offline optimum,\n{len(found.starts)} starts, {found.path_name}"
    )


def _logarithmic(axes: Axes, x: bool = False, y: bool = False) -> None:
    """Make axes logarithmic that have something to show; say it where there is nothing."""
    if x:
        axes.set_xscale("log")
    if y:
        axes.set_yscale("log")
    if not (x or y):
        text = "no J/J*: no optimum is known, or every run failed"
        axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center")


def _cross_track(found: Comparison, figure: Figure) -> None:
    """Draw the distance from the path over the lap, the best controllers apart."""
    panels = figure.subplots(2, 1, sharex=True)
    ranked = sorted(found.outcomes, key=_tracking)
    best = [outcome for outcome in ranked if _tracking(outcome) < 2e-3]
    others = [outcome for outcome in ranked if 2e-3 <= _tracking(outcome) < math.inf]
    for axes, group, unit, factor in (
        (panels[0], best[:6], "mm", 1e3),
        (panels[1], others[:6], "cm", 1e2),
    ):
        for color, outcome in zip(COLORS, group, strict=False):
            label = f"{outcome.name}, RMS {factor * outcome.cross_track_rms:.2g} {unit}"
            distance = factor * outcome.cross_track
            axes.plot(outcome.lap_time, distance, color=color, linewidth=1, label=label)
        axes.set_ylabel(f"cross-track error [{unit}]")
        if group:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    panels[0].set_title(f"One lap after 10 s, {found.path_name}: below and above 2 mm RMS")
    panels[1].set_xlabel("time [s]")


def _tracking(outcome: Outcome) -> float:
    rms = outcome.cross_track_rms
    return rms if math.isfinite(rms) else math.inf


def _cost_per_step(found: Comparison, figure: Figure) -> None:
    axes: Axes = figure.subplots()
    ranked = sorted(found.outcomes, key=lambda outcome: outcome.quantile(0.95))
    for number, outcome in enumerate(ranked):
        loss = outcome.quantile(0.95) - 1.0
        if not math.isfinite(loss):
            continue
        place = (1e3 * outcome.step_time, max(loss, _LEAST_LOSS))
        axes.plot(*place, "o", color=_color(outcome.name))
        # Neighbours get their names on different sides.
        side, offset = ("left", 6) if number % 2 else ("right", -6)
        written: dict[str, Any] = {"ha": side, "va": "center", "fontsize": 8}
        axes.annotate(outcome.name, place, (offset, 0), textcoords="offset points", **written)
    drawn = any(math.isfinite(outcome.quantile(0.95)) for outcome in ranked)
    _logarithmic(axes, x=drawn, y=drawn)
    if drawn:
        axes.margins(x=0.35, y=0.1)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("computing time of one control step [ms], this machine")
    axes.set_ylabel("loss J/J* − 1, 95th percentile")
    axes.set_title(f"Cost against computing time, {found.path_name}")
