"""The figures of the page, as Plotly has them."""

import html
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from adp_path_follower.analysis.bag_analysis import BagAnalysis
from adp_path_follower.analysis.events import KINDS
from adp_path_follower.drawing.charts import Panel, Track
from adp_path_follower.drawing.figure_style import DISTANCE_SCALES, color, is_dashed

_GREY = "rgba(128,128,128,0.35)"
_PATH_COLOR = "rgba(128,128,128,0.6)"
_PANEL_HEIGHT = 190  # [px]
_FRAME = 90  # [px] above and below the panels
_SYMBOLS = dict(zip(KINDS, ("circle", "x", "triangle-up", "diamond", "square"), strict=True))


def page_figures(analyses: Sequence[BagAnalysis]) -> dict[str, Any]:
    """Return key -> figure (data and layout) of all that the bags can show."""
    figures = {"track": _track(analyses)}
    keys = dict.fromkeys(key for analysis in analyses for key in analysis.charts.panels)
    for key in keys:
        figures[key] = _over_time(key, analyses)
    for key in ("period", "latency"):
        if any(key in analysis.charts.histograms for analysis in analyses):
            figures[key] = _histogram(key, analyses)
    if any(analysis.events for analysis in analyses):
        figures["events"] = _events(analyses)
    found = {}
    for key, figure in figures.items():
        content = figure.to_dict()
        content["layout"].pop("template", None)  # the page has its own colours
        content["over_time"] = key in keys or key == "events"
        found[key] = content
    return found


def motions(analyses: Sequence[BagAnalysis]) -> list[dict[str, Any]]:
    """Return where each robot and its virtual target were."""
    return [
        {
            "name": analysis.name,
            "color": color(index),
            "time": _small(analysis.charts.track.moving_time),
            "x": _small(analysis.charts.track.robot[:, 0]),
            "y": _small(analysis.charts.track.robot[:, 1]),
            "theta": _small(np.unwrap(analysis.charts.track.robot[:, 2])),
            "target_x": _small(analysis.charts.track.target[:, 0]),
            "target_y": _small(analysis.charts.track.target[:, 1]),
        }
        for index, analysis in enumerate(analyses)
    ]


def _plain(text: str) -> str:
    """Return a text that Plotly shows as it is, where it would take tags for its own."""
    return html.escape(text, quote=False)


def _small(values: np.ndarray) -> np.ndarray:
    """Return numbers in half the bytes; a figure needs no more digits."""
    return np.asarray(values, dtype=np.float32)


def _track(analyses: Sequence[BagAnalysis]) -> go.Figure:
    figure = go.Figure()
    for index, analysis in enumerate(analyses):
        points = analysis.charts.track.path
        figure.add_scatter(
            x=_small(points[:, 0]),
            y=_small(points[:, 1]),
            mode="lines",
            line={"color": _PATH_COLOR, "width": 6, "simplify": False},
            name="path",
            showlegend=index == 0,
            hoverinfo="skip",
        )
    for index, analysis in enumerate(analyses):
        track = analysis.charts.track
        several = len(analyses) > 1
        marker: dict[str, Any] = {"size": 4, "color": color(index)}
        if not several:
            marker |= _by_distance(track)
        figure.add_scatter(
            x=_small(track.position[:, 0]),
            y=_small(track.position[:, 1]),
            customdata=_small(np.column_stack([track.time, track.cross_track])),
            mode="lines" if several else "markers",
            marker=marker,
            line={"color": color(index)},
            name=_plain(analysis.name),
            hovertemplate="%{customdata[0]:.2f} s: %{customdata[1]:.4f} m<extra></extra>",
        )
    figure.update_layout(
        height=520,
        xaxis={"title": {"text": "x [m]"}},
        yaxis={"title": {"text": "y [m]"}, "scaleanchor": "x", "scaleratio": 1},
        showlegend=len(analyses) > 1,
    )
    return figure


def _by_distance(track: Track) -> dict[str, Any]:
    """Return markers coloured by the distance from the path; the page's theme recolours them."""
    ticks = np.linspace(0.0, track.color_limit, 5)
    texts = [f"{tick:.3g}" for tick in ticks]
    return {
        "color": _small(np.abs(track.cross_track)),
        "colorscale": list(DISTANCE_SCALES["light"]),
        "cmin": 0.0,
        "cmax": track.color_limit,
        "showscale": True,
        "colorbar": {
            "title": {"text": "|cross-track| [m]", "side": "right"},
            "tickvals": ticks.tolist(),
            "ticktext": [*texts[:-1], f"≥ {texts[-1]}"],
        },
    }


def _over_time(key: str, analyses: Sequence[BagAnalysis]) -> go.Figure:
    rows = max(len(analysis.charts.panels.get(key, ())) for analysis in analyses)
    figure = make_subplots(rows=rows, cols=1, shared_xaxes=True, vertical_spacing=0.06)
    several = len(analyses) > 1
    limits: dict[int, set[float]] = {}
    named: set[str] = set()
    for index, analysis in enumerate(analyses):
        for row, panel in enumerate(analysis.charts.panels.get(key, ()), start=1):
            limits.setdefault(row, set()).update(filter(np.isfinite, panel.limits))
            by_line = not several and len(panel.lines) > 1
            for trace in _traces(panel, index, analysis.name, by_line, by_line or several):
                trace.showlegend = trace.showlegend and trace.legendgroup not in named
                if trace.showlegend:
                    named.add(str(trace.legendgroup))
                figure.add_trace(trace, row=row, col=1)
            figure.update_yaxes(title_text=panel.label, row=row, col=1)
            if panel.logarithmic:
                figure.update_yaxes(type="log", exponentformat="power", row=row, col=1)
    for row, values in limits.items():
        for value in sorted(values):
            figure.add_hline(value, row=row, col=1, line={"dash": "dash", "color": "#888888"})
    figure.update_xaxes(range=_span(analyses))
    figure.update_xaxes(title_text="time [s]", row=rows, col=1)
    figure.update_layout(height=_FRAME + _PANEL_HEIGHT * rows, showlegend=bool(named))
    return figure


def _span(analyses: Sequence[BagAnalysis]) -> list[float]:
    """Return from when to when the bags go [s], with a little room."""
    times = [analysis.charts.track.moving_time for analysis in analyses]
    first, last = min(time[0] for time in times), max(time[-1] for time in times)
    room = 0.01 * max(last - first, 1e-3)
    return [float(first - room), float(last + room)]


def _traces(panel: Panel, index: int, bag: str, by_line: bool, named: bool) -> list[go.Scatter]:
    """Return the curves of a panel: coloured by curve, or by bag."""
    traces = []
    number = 0
    for line in panel.lines:
        dash = "dash" if is_dashed(number) else "solid"
        name = line.name if by_line else bag
        traces.append(
            go.Scatter(
                x=_small(line.time),
                y=_small(line.values),
                mode="lines",
                line={
                    "color": _GREY if line.background else color(number if by_line else index),
                    "dash": "solid" if line.background or not by_line else dash,
                    "width": 1 if line.background else 1.6,
                },
                name=_plain(name),
                legendgroup=_plain(name),
                showlegend=named and not line.background,
                hoverinfo="skip" if line.background else None,
                hovertemplate=None
                if line.background
                else f"{_plain(line.name)}: %{{y:.5g}} at %{{x:.2f}} s<extra></extra>",
            )
        )
        number += not line.background
    return traces


def _histogram(key: str, analyses: Sequence[BagAnalysis]) -> go.Figure:
    figure = go.Figure()
    lows: list[float] = []
    highs: list[float] = []
    for index, analysis in enumerate(analyses):
        found = analysis.charts.histograms.get(key)
        if found is None:
            continue
        shown = found.counts > 0
        figure.add_bar(
            x=0.5 * (found.edges[1:] + found.edges[:-1])[shown],
            y=found.counts[shown],
            width=float(found.edges[1] - found.edges[0]),
            marker={"color": color(index), "line": {"color": color(index), "width": 1}},
            opacity=0.7 if len(analyses) > 1 else 1.0,
            name=_plain(analysis.name),
            hovertemplate="%{x:.3g} ms: %{y} times<extra></extra>",
        )
        figure.update_xaxes(title_text=found.label)
        lows.append(float(found.edges[0]))
        highs.append(float(found.edges[-1]))
    most = max(
        int(analysis.charts.histograms[key].counts.max())
        for analysis in analyses
        if key in analysis.charts.histograms
    )
    # A logarithmic axis shows the one late command beside a million in time.
    figure.update_yaxes(
        title_text="how often",
        type="log",
        exponentformat="power",
        dtick=1,
        range=[-0.3, math.log10(most) + 0.3],
    )
    figure.update_xaxes(range=[min(lows), max(highs)])
    figure.update_layout(
        height=_FRAME + _PANEL_HEIGHT, barmode="overlay", showlegend=len(analyses) > 1
    )
    return figure


def _events(analyses: Sequence[BagAnalysis]) -> go.Figure:
    figure = go.Figure()
    for index, analysis in enumerate(analyses):
        events = analysis.events
        if not events:
            continue
        figure.add_scatter(
            x=[event.time for event in events],
            y=[event.kind for event in events],
            text=[_plain(event.text) for event in events],
            mode="markers",
            marker={
                "size": 11,
                "color": color(index),
                "symbol": [_SYMBOLS[event.kind] for event in events],
            },
            name=_plain(analysis.name),
            hovertemplate="%{x:.2f} s: %{text}<extra></extra>",
        )
    figure.update_yaxes(  # all kinds, so that figures of several reports can be compared
        categoryorder="array",
        categoryarray=list(reversed(KINDS)),
        range=[-0.5, len(KINDS) - 0.5],
        automargin=True,
    )
    figure.update_xaxes(title_text="time [s]", range=_span(analyses))
    figure.update_layout(height=_FRAME + _PANEL_HEIGHT, showlegend=len(analyses) > 1)
    return figure
