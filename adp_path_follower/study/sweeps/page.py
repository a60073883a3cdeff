"""The page of a sweep or a tuning: figures and tables that open without network."""

import html
import itertools
import math
from collections.abc import Sequence
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import plotly.graph_objects as go
from optuna.trial import FrozenTrial

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.drawing.figure_style import COLORS, POINT_COLOR
from adp_path_follower.drawing.page import write_page
from adp_path_follower.study.sweeps.conditions import WHERE_KNOWN
from adp_path_follower.study.sweeps.objectives import OBJECTIVES, UNSTABLE_SCORE
from adp_path_follower.study.sweeps.ranges import Listed, Variation
from adp_path_follower.study.sweeps.results import Results, shown
from adp_path_follower.study.sweeps.study import score_of

_ROWS = 25
_MOST_MAPS = 6
_BINS = 12  # of a range in a heat map, at most
_MOST_POINTS = 3000  # that are drawn
_HEIGHT = 420  # [px]


def write_sweep_page(found: Results, title: str, file: FilePath) -> None:
    """Write the page of a sweep or a tuning; raise FileError if it cannot be written."""
    figures, asked = sweep_figures(found), found.request.objectives
    write_page(
        file,
        "sweep",
        {"figures": {key: figure for key, (*_, figure) in figures.items()}},
        title=title,
        found=found,
        conditions=found.request.conditions,
        names=[item.name for item in found.request.variations],
        objectives=[(name, _words(found, name), OBJECTIVES[name].unit) for name in asked],
        rows=[_row(found, trial) for trial in found.stable[:_ROWS]],
        front=[_row(found, trial) for trial in found.front[:_ROWS]],
        captions=[(key, title, caption) for key, (title, caption, _) in figures.items()],
        number=shown,
        where_known=WHERE_KNOWN,
    )


def _row(found: Results, trial: FrozenTrial) -> list[str]:
    scores = [score_of(trial).objectives[name] for name in found.request.objectives]
    numbers = [f"{score:.5g}" if score < UNSTABLE_SCORE else "–" for score in scores]
    return [*map(shown, found.values(trial).values()), *numbers]


def sweep_figures(found: Results) -> dict[str, tuple[str, str, dict[str, Any]]]:
    """Return key -> title, caption and figure (data and layout), in the order of the page."""
    figures: dict[str, tuple[str, str, go.Figure]] = {}
    first, second = (*found.request.objectives, "")[:2]
    if second and np.isfinite(_objective(found.stable, second)).any():
        figures["pareto"] = (
            "Pareto front",
            f"Each point is a combination of settings that is stable in all its runs: {first} "
            f"({_words(found, first)}) against {second} ({_words(found, second)}). No "
            "point is better in all objectives than a point of the front.",
            _pareto(found),
        )
    name, values, caption = _measure(found)
    axes = [_Axis(item, found) for item in found.importance]
    if len(axes) == 1:
        title, caption = f"{name} over {axes[0].name}", f"{caption}: the median at each value."
        figures["map_1"] = (title, caption, _curve(_title(found, name), values, axes[0]))
    pairs = sorted(itertools.combinations(range(len(axes)), 2), key=sum)[:_MOST_MAPS]
    for number, (across, up) in enumerate(pairs, start=1):
        figures[f"map_{number}"] = (
            f"{name} over {axes[across].name} and {axes[up].name}",
            f"{caption}: the median over everything else that varies. × marks fields in which no "
            "combination is stable; point at one to read the number of combinations.",
            _heat_map(_title(found, name), values, axes[across], axes[up]),
        )
    return {
        key: (title, caption, figure.to_dict()) for key, (title, caption, figure) in figures.items()
    }


def _measure(found: Results) -> tuple[str, FloatArray, str]:
    """Return the maps' name, values (C,) and caption: the first objective, else unstable runs."""
    name = found.request.objectives[0]
    shares = np.array([score_of(trial).unstable for trial in found.trials]) / (
        found.request.conditions.runs
    )
    if not found.stable:
        return (
            "unstable runs",
            shares,
            "Share of runs that are unstable, as no combination is stable in all its runs",
        )
    caption = f"{name} ({_words(found, name)}) of the combinations that are stable in all runs"
    return name, np.where(shares == 0.0, _objective(found.trials, name), math.nan), caption


def _words(found: Results, name: str) -> str:
    """Return an objective in words: costs are J where J* is not known of all runs."""
    words = OBJECTIVES[name].meaning
    return words if found.relative else words.replace("J/J*", "J")


def _objective(trials: Sequence[FrozenTrial], name: str) -> FloatArray:
    """Return an objective of each trial, NaN where a run is lost or never settles."""
    values = np.array([score_of(trial).objectives[name] for trial in trials])
    return np.where(values < UNSTABLE_SCORE, values, math.nan)


class _Axis:
    """A variation in bins: one for each value, or stretches of a range."""

    def __init__(self, item: Variation, found: Results) -> None:
        self.name = item.name
        values = [item.value(trial.params[item.name]) for trial in found.trials]
        if isinstance(item, Listed):
            self.labels = [shown(value) for value in item.values]
            self.bins = np.array([item.values.index(value) for value in values])
            return
        numbers = np.array(values, dtype=float)
        bins = max(2, min(_BINS, int(math.sqrt(len(values)))))
        edges = np.unique(np.quantile(numbers, np.linspace(0.0, 1.0, bins + 1)))
        edges = edges if len(edges) > 1 else np.repeat(edges, 2)  # one value only
        places = np.searchsorted(edges, numbers, side="right") - 1
        self.bins = np.clip(places, 0, len(edges) - 2)
        self.labels = [f"{low:.3g} to {high:.3g}" for low, high in itertools.pairwise(edges)]


def _heat_map(title: str, score: FloatArray, first: _Axis, second: _Axis) -> go.Figure:
    """Return a map of the median score over everything else that varies."""
    median = np.full((len(second.labels), len(first.labels)), math.nan)
    text = np.full(median.shape, "", dtype=object)
    unstable = []  # fields, as the labels of both axes
    for row, column in np.ndindex(*median.shape):
        inside = (second.bins == row) & (first.bins == column)
        known = inside & np.isfinite(score)
        if known.any():
            median[row, column] = np.median(score[known])
            text[row, column] = f"of {int(known.sum())} of {int(inside.sum())} combinations"
        elif inside.any():
            unstable.append((first.labels[column], second.labels[row]))
    figure = go.Figure(
        go.Heatmap(
            x=first.labels,
            y=second.labels,
            z=median.tolist(),
            customdata=text,
            colorscale="Viridis",
            reversescale=True,
            colorbar={"title": {"text": title, "side": "top"}},
            hoverongaps=False,
            hovertemplate="%{x}, %{y}: %{z:.5g}, median %{customdata}<extra></extra>",
        )
    )
    figure.add_scatter(
        x=[label for label, _ in unstable],
        y=[label for _, label in unstable],
        mode="markers",
        marker={"symbol": "x", "size": 9, "color": COLORS[1]},
        hovertemplate="%{x}, %{y}: none is stable<extra></extra>",
    )
    figure.update_xaxes(title_text=first.name, type="category", automargin=True)
    figure.update_yaxes(
        title={"text": second.name, "standoff": 10}, type="category", automargin=True
    )
    figure.update_layout(height=_HEIGHT, showlegend=False)
    return figure


def _curve(title: str, score: FloatArray, axis: _Axis) -> go.Figure:
    """Return a curve of the median score over the only variation."""
    groups = [score[(axis.bins == place) & np.isfinite(score)] for place in range(len(axis.labels))]
    medians = np.array([np.median(some) if len(some) else math.nan for some in groups])
    figure = go.Figure()
    figure.add_scatter(
        x=axis.labels,
        y=medians.tolist(),
        mode="lines+markers",
        line={"color": COLORS[0]},
        hovertemplate="%{x}: %{y:.5g}<extra></extra>",
    )
    figure.update_xaxes(title_text=axis.name, type="category", automargin=True)
    figure.update_yaxes(title_text=title)
    figure.update_layout(height=_HEIGHT, showlegend=False)
    return figure


def _pareto(found: Results) -> go.Figure:
    """Return a figure of all stable combinations by the first two objectives, with the front."""
    names = found.request.objectives[:2]
    spread = np.linspace(0, len(found.stable) - 1, min(len(found.stable), _MOST_POINTS)).astype(int)
    figure = go.Figure()
    some = [found.stable[place] for place in spread]
    for trials, name, mode, color in (
        (some, "settings", "markers", POINT_COLOR),
        (found.front, "Pareto front", "lines+markers", COLORS[1]),
    ):
        figure.add_scatter(
            x=_objective(trials, names[0]).tolist(),
            y=_objective(trials, names[1]).tolist(),
            mode=mode,
            name=name,
            line={"color": color, "shape": "hv"},
            marker={"size": 9 if mode != "markers" else 6, "color": color},
            text=[_described(found, trial) for trial in trials],
            hovertemplate="%{text}<br>%{x:.5g}, %{y:.5g}<extra></extra>",
        )
    figure.update_xaxes(title_text=_title(found, names[0]))
    figure.update_yaxes(title_text=_title(found, names[1]))
    figure.update_layout(height=_HEIGHT, showlegend=True)
    return figure


def _described(found: Results, trial: FrozenTrial) -> str:
    values = found.values(trial)
    text = ", ".join(f"{name}: {shown(value)}" for name, value in values.items())
    return html.escape(text, quote=False)  # Plotly would interpret tags


def _title(found: Results, name: str) -> str:
    """Return the name of an axis, with its unit or which cost it is."""
    if name not in OBJECTIVES:
        return name
    if OBJECTIVES[name].column == "cost":
        return f"{name}, {'J/J*' if found.relative else 'J'}"
    unit = OBJECTIVES[name].unit
    return f"{name} [{unit}]" if unit else name
