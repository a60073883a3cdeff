"""The results of a sweep: an HTML file that opens without network, and the best settings."""

import html
import itertools
import math
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import plotly.graph_objects as go

from adp_path_follower import __version__
from adp_path_follower.core.files import output_to
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.drawing.figure_style import COLORS
from adp_path_follower.drawing.page import write_page
from adp_path_follower.study.sweeps.overview import Overview, shown, write_settings
from adp_path_follower.study.sweeps.request.conditions import WHERE_KNOWN
from adp_path_follower.study.sweeps.request.objectives import OBJECTIVES
from adp_path_follower.study.sweeps.request.ranges import Listed, Variation

_ROWS = 25
_MOST_MAPS = 6
_BINS = 12  # of a range in a heat map, at most
_MOST_POINTS = 3000  # that are drawn
_HEIGHT = 420  # [px]


def write_results(found: Overview, title: str, directory: FilePath) -> None:
    """Write the page, and the best settings as a parameter file; may raise FileError."""
    write_sweep_page(found, title, directory / "report.html")
    best = directory / "best.yaml"
    if found.best is None:
        with output_to(best):
            best.unlink(missing_ok=True)
        return
    scores = ", ".join(
        f"{name} {found.scores[name][found.best]:.5g}" for name in found.sweep.objectives
    )
    comment = f"The best settings of {title} ({scores}), found by adp sweep {__version__}."
    settings, values = found.sweep.settings(found.best), found.sweep.varied(found.best)
    write_settings(best, settings, comment, values)


def write_sweep_page(found: Overview, title: str, file: FilePath) -> None:
    """Write the report of a sweep; raise FileError if it cannot be written."""
    sweep = found.sweep
    figures = sweep_figures(found)
    names = [item.name for item in sweep.variations]
    write_page(
        file,
        "sweep",
        {"figures": figures},
        title=title,
        found=found,
        sweep=sweep,
        names=names,
        objectives=[OBJECTIVES[name] for name in sweep.objectives],
        rows=[_row(found, names, int(number)) for number in found.ranked[:_ROWS]],
        front=[_row(found, names, int(number)) for number in found.front[:_ROWS]],
        captions=[(key, *_caption(key, figures[key], found)) for key in figures],
        number=shown,
        where_known=WHERE_KNOWN,
    )


def _row(found: Overview, names: list[str], number: int) -> list[str]:
    values = found.sweep.varied(number)
    scores = [f"{found.scores[name][number]:.5g}" for name in found.sweep.objectives]
    return [*(shown(values[name]) for name in names), *scores]


def _caption(key: str, figure: dict, found: Overview) -> tuple[str, str]:
    first = found.sweep.objectives[0]
    if key == "pareto":
        second = found.sweep.objectives[1]
        return (
            "Pareto front",
            f"Each point is a combination of settings that is stable in all its runs: {first} "
            f"({OBJECTIVES[first].meaning}) against {second} ({OBJECTIVES[second].meaning}). No "
            "point is better in both than a point of the front.",
        )
    layout, (name, _, caption) = figure["layout"], _measure(found)
    across = str(layout["xaxis"]["title"]["text"])
    up = str(layout["yaxis"]["title"]["text"])
    if up == name:
        return (f"{name} over {across}", f"{caption}: the median at each value.")
    return (
        f"{name} over {across} and {up}",
        f"{caption}: the median over everything else that varies; empty where there is none. "
        "Point at a field to read the number of combinations.",
    )


def sweep_figures(found: Overview) -> dict[str, Any]:
    """Return key -> figure (data and layout), in the order of the page."""
    figures: dict[str, go.Figure] = {}
    if len(found.sweep.objectives) > 1 and len(found.ranked):
        figures["pareto"] = _pareto(found)
    name, values, _ = _measure(found)
    axes = _by_effect(found, values)
    if len(axes) == 1:
        figures["map_1"] = _curve(name, values, axes[0])
    pairs = sorted(itertools.combinations(range(len(axes)), 2), key=sum)[:_MOST_MAPS]
    for number, (first, second) in enumerate(pairs, start=1):
        figures[f"map_{number}"] = _heat_map(name, values, axes[first], axes[second])
    content = {key: figure.to_dict() for key, figure in figures.items()}
    for item in content.values():
        item["layout"].pop("template", None)  # the page has its own colours
    return content


def _measure(found: Overview) -> tuple[str, FloatArray, str]:
    """Return the maps' name, values (C,) and caption: the first objective, else unstable runs."""
    name = found.sweep.objectives[0]
    if not len(found.ranked):
        return (
            "unstable runs",
            found.shares_unstable,
            "Share of runs that are unstable, as no combination is stable in all its runs",
        )
    values = np.where(found.unstable == 0, found.scores[name], math.nan)
    caption = f"{name} ({OBJECTIVES[name].meaning}) of the combinations that are stable in all runs"
    return name, values, caption


class _Axis:
    """A variation in bins: one for each value, or stretches of a range."""

    def __init__(self, item: Variation, found: Overview) -> None:
        self.name = item.name
        count = found.sweep.combinations
        values = [found.sweep.varied(number)[item.name] for number in range(count)]
        if isinstance(item, Listed):
            self.labels = [shown(value) for value in item.values]
            place_of = {value: place for place, value in enumerate(item.values)}
            self.bins = np.array([place_of[value] for value in values])
            return
        numbers = np.array(values, dtype=float)
        bins = max(2, min(_BINS, int(math.sqrt(count))))
        edges = np.unique(np.quantile(numbers, np.linspace(0.0, 1.0, bins + 1)))
        edges = edges if len(edges) > 1 else np.repeat(edges, 2)  # one value only
        places = np.searchsorted(edges, numbers, side="right") - 1
        self.bins = np.clip(places, 0, len(edges) - 2)
        self.labels = [f"{low:.3g} to {high:.3g}" for low, high in itertools.pairwise(edges)]

    def effect(self, score: FloatArray) -> float:
        """Return the share of a score's variance that the bins of this axis explain."""
        known = np.isfinite(score)
        total = float(np.var(score[known])) if known.any() else 0.0
        if not total:
            return 0.0
        mean = score[known].mean()
        groups = [score[known & (self.bins == place)] for place in range(len(self.labels))]
        between = sum(len(some) * (some.mean() - mean) ** 2 for some in groups if len(some))
        return float(between / known.sum() / total)


def _by_effect(found: Overview, score: FloatArray) -> list[_Axis]:
    """Return the variations, the one that matters most to a score first."""
    # Ranks, as a few combinations that are much worse would decide alone.
    ranks = np.full(len(score), math.nan)
    known = np.isfinite(score)
    ranks[known] = np.argsort(np.argsort(score[known]))
    axes = [_Axis(item, found) for item in found.sweep.variations]
    return sorted(axes, key=lambda axis: -axis.effect(ranks))


def _heat_map(name: str, score: FloatArray, first: _Axis, second: _Axis) -> go.Figure:
    """Return a map of the median score over everything else that varies."""
    median = np.full((len(second.labels), len(first.labels)), math.nan)
    text = np.full(median.shape, "", dtype=object)
    for row, column in np.ndindex(*median.shape):
        inside = (second.bins == row) & (first.bins == column)
        known = inside & np.isfinite(score)
        if known.any():
            median[row, column] = np.median(score[known])
        if inside.any():
            text[row, column] = f"of {int(known.sum())} of {int(inside.sum())} combinations"
    figure = go.Figure(
        go.Heatmap(
            x=first.labels,
            y=second.labels,
            z=_nones(median),
            customdata=text,
            colorscale="Viridis",
            reversescale=True,
            colorbar={"title": {"text": name, "side": "right"}},
            hoverongaps=False,
            hovertemplate="%{x}, %{y}: %{z:.5g}, median %{customdata}<extra></extra>",
        )
    )
    figure.update_xaxes(title_text=first.name, type="category", automargin=True)
    figure.update_yaxes(
        title={"text": second.name, "standoff": 10}, type="category", automargin=True
    )
    figure.update_layout(height=_HEIGHT)
    return figure


def _curve(name: str, score: FloatArray, axis: _Axis) -> go.Figure:
    """Return a curve of the median score over the only variation."""
    groups = [score[(axis.bins == place) & np.isfinite(score)] for place in range(len(axis.labels))]
    medians = np.array([np.median(some) if len(some) else math.nan for some in groups])
    figure = go.Figure()
    figure.add_scatter(
        x=axis.labels,
        y=_nones(medians),
        mode="lines+markers",
        line={"color": COLORS[0]},
        hovertemplate="%{x}: %{y:.5g}<extra></extra>",
    )
    figure.update_xaxes(title_text=axis.name, type="category", automargin=True)
    figure.update_yaxes(title_text=name)
    figure.update_layout(height=_HEIGHT, showlegend=False)
    return figure


def _pareto(found: Overview) -> go.Figure:
    """Return a figure of all stable combinations by the first two objectives, with the front."""
    first, second = found.sweep.objectives[:2]
    front, ranked = found.front, found.ranked
    spread = np.linspace(0, len(ranked) - 1, min(len(ranked), _MOST_POINTS)).astype(int)
    figure = go.Figure()
    for numbers, name, mode, color in (
        (ranked[spread], "settings", "markers", "rgba(128,128,128,0.55)"),
        (front, "Pareto front", "lines+markers", COLORS[1]),
    ):
        figure.add_scatter(
            x=_nones(found.scores[first][numbers]),
            y=_nones(found.scores[second][numbers]),
            mode=mode,
            name=name,
            line={"color": color, "shape": "hv"},
            marker={"size": 9 if mode != "markers" else 6, "color": color},
            text=[_described(found, int(number)) for number in numbers],
            hovertemplate="%{text}<br>%{x:.5g}, %{y:.5g}<extra></extra>",
        )
    figure.update_xaxes(title_text=_title(first))
    figure.update_yaxes(title_text=_title(second))
    figure.update_layout(height=_HEIGHT, showlegend=True)
    return figure


def _described(found: Overview, number: int) -> str:
    values = found.sweep.varied(number)
    text = ", ".join(f"{name}: {shown(value)}" for name, value in values.items())
    return html.escape(text, quote=False)  # Plotly would interpret tags


def _title(name: str) -> str:
    unit = OBJECTIVES[name].unit
    return f"{name} [{unit}]" if unit else name


def _nones(values: np.ndarray) -> list[Any]:
    """Return numbers for JSON, None for those that are not finite."""
    if values.ndim > 1:
        return [_nones(row) for row in values]
    return [float(value) if math.isfinite(value) else None for value in values]
