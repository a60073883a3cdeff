"""The figures of the page, as Plotly has them."""

import html
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.drawing.charts import (
    KINDS,
    Line,
    Panel,
    ShownRun,
    SteeringMap,
    Track,
    curve_numbers,
    rounded_up,
)
from adp_path_follower.drawing.figure_style import (
    COLORS,
    DISTANCE_SCALES,
    PATH_COLOR,
    POINT_COLOR,
    color,
    is_dashed,
)

_GREY = "rgba(128,128,128,0.45)"
_LETTERS = 40  # of a name in a legend
_FEW = 8  # lines that stand out although they are behind the others
_OPTIMUM = COLORS[1]
_PANEL_HEIGHT = 190  # [px]
_ROOM = 0.06  # between two panels, as a share of all
_FRAME = 90  # [px] above and below the panels
_HALTS = {"fault": "rgba(213,94,0,0.18)"}  # the colour behind a state; grey for the others
_SYMBOLS = dict(zip(KINDS, ("circle", "x", "triangle-up", "diamond", "square"), strict=True))


def page_data(runs: Sequence[ShownRun]) -> dict[str, Any]:
    """Return what the page's script shows of runs: figures, motions, and colours of distances."""
    scales = {  # by theme, as Plotly has them: place from 0 to 1, colour
        theme: list(zip(np.linspace(0.0, 1.0, len(colors)).tolist(), colors, strict=True))
        for theme, colors in DISTANCE_SCALES.items()
    }
    return {"figures": page_figures(runs), "motions": _motions(runs), "scales": scales}


def page_figures(runs: Sequence[ShownRun]) -> dict[str, Any]:
    """Return key -> figure (data and layout) of all that the runs can show."""
    figures = {"track": _track(runs)}
    keys = dict.fromkeys(key for run in runs for key in run.charts.panels)
    for key in keys:
        figures[key] = _over_time(key, runs)
    for key in ("period", "latency"):
        if any(key in run.charts.histograms for run in runs):
            figures[key] = _histogram(key, runs)
    if any(run.events for run in runs):
        figures["events"] = _events(runs)
    if len(runs) == 1:
        maps = runs[0].charts.steering
        for key, found in zip(("policy_before", "policy_after"), maps, strict=False):
            figures[key] = _steering(found, maps)
    return {
        key: {**figure.to_dict(), "over_time": key in keys or key == "events"}
        for key, figure in figures.items()
    }


def _motions(runs: Sequence[ShownRun]) -> list[dict[str, Any]]:
    """Return where each robot and its virtual target were, and the optimum beside a single one."""
    found = []
    for index, run in enumerate(runs):
        track = run.charts.track
        found.append(_motion(run.name, color(index), track.moving_time, track.robot, track.target))
    optimum = runs[0].charts.optimum if len(runs) == 1 else None
    if optimum is not None:
        nowhere = np.full((len(optimum), 2), np.nan)
        found.append(_motion("optimum", _OPTIMUM, optimum[:, 0], optimum[:, 1:], nowhere))
    return found


def _motion(
    name: str, shown: str, time: FloatArray, poses: FloatArray, target: FloatArray
) -> dict[str, Any]:
    """Return a robot's times, poses and target as the page's script reads them."""
    return {
        "name": name,
        "color": shown,
        "time": _small(time),
        "x": _small(poses[:, 0]),
        "y": _small(poses[:, 1]),
        "theta": _small(np.unwrap(poses[:, 2])),
        "target_x": _small(target[:, 0]),
        "target_y": _small(target[:, 1]),
    }


def _plain(text: str) -> str:
    """Return a text that Plotly shows as it is, where it would take tags for its own."""
    return html.escape(text, quote=False)


def _short(name: str) -> str:
    """Return the end of a name that is too long for a legend, in Plotly's letters."""
    return _plain(name if len(name) <= _LETTERS else f"…{name[1 - _LETTERS :]}")


def _small(values: np.ndarray) -> np.ndarray:
    """Return numbers in half the bytes; a figure needs no more digits."""
    return np.asarray(values, dtype=np.float32)


def _track(runs: Sequence[ShownRun]) -> go.Figure:
    figure = go.Figure()
    for index, run in enumerate(runs):
        points = run.charts.track.path
        figure.add_scatter(
            x=_small(points[:, 0]),
            y=_small(points[:, 1]),
            mode="lines",
            line={"color": PATH_COLOR, "width": 6, "simplify": False},
            name="path",
            showlegend=index == 0,
            hoverinfo="skip",
        )
    for index, run in enumerate(runs):
        track = run.charts.track
        several = len(runs) > 1
        marker: dict[str, Any] = {"size": 4, "color": color(index)}
        if not several:
            marker |= _by_distance(track)
        figure.add_scatter(
            x=_small(track.position[:, 0]),
            y=_small(track.position[:, 1]),
            customdata=_small(np.column_stack([track.time, 1e3 * track.cross_track])),
            mode="lines" if several else "lines+markers",
            marker=marker,
            line={"color": color(index)} if several else {"color": _GREY, "width": 1},
            name=_short(run.name),
            hovertemplate="%{customdata[0]:.2f} s: %{customdata[1]:.3f} mm<extra></extra>",
        )
    optimum = runs[0].charts.optimum if len(runs) == 1 else None
    if optimum is not None:
        figure.add_scatter(
            x=_small(optimum[:, 1]),
            y=_small(optimum[:, 2]),
            mode="lines",
            line={"color": _OPTIMUM, "width": 2, "dash": "dot"},
            name="optimum",
            hoverinfo="skip",
        )
    drawn = np.concatenate(
        [part for run in runs for part in (run.charts.track.path, run.charts.track.position)]
    )
    (left, right), (low, high) = (_with_room(drawn[:, column]) for column in (0, 1))
    figure.update_layout(
        height=520,
        xaxis={"title": {"text": "x [m]"}, "range": [left, right]},
        yaxis={"title": {"text": "y [m]"}, "scaleanchor": "x", "range": [low, high]},
        showlegend=len(runs) > 1 or optimum is not None,
    )
    return figure


def _with_room(values: FloatArray) -> tuple[float, float]:
    """Return least and greatest of the finite values with room beside them."""
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    room = max(0.05 * (high - low), 1e-3)
    return low - room, high + room


def _by_distance(track: Track) -> dict[str, Any]:
    """Return markers coloured by the distance from the path; the page's theme recolours them."""
    step = rounded_up(250.0 * track.color_limit)
    ticks = step * np.arange(5)
    texts = [f"{tick:g}" for tick in ticks]
    return {
        "color": _small(1e3 * np.abs(track.cross_track)),
        "colorscale": list(DISTANCE_SCALES["light"]),
        "cmin": 0.0,
        "cmax": float(ticks[-1]),
        "showscale": True,
        "colorbar": {
            "title": {"text": "|cross-track| [mm]", "side": "right"},
            "tickvals": ticks.tolist(),
            "ticktext": [*texts[:-1], f"≥ {texts[-1]}"],
        },
    }


def _over_time(key: str, runs: Sequence[ShownRun]) -> go.Figure:
    """Return panels below each other that share the axis of time, and with it one label."""
    rows = max(len(run.charts.panels.get(key, ())) for run in runs)
    figure = go.Figure()
    several = len(runs) > 1
    limits: dict[int, set[float]] = {}
    named: set[str] = set()
    height = (1.0 - _ROOM * (rows - 1)) / rows
    for index, run in enumerate(runs):
        panels = run.charts.panels.get(key, ())
        numbers = {} if several else curve_numbers(panels)
        for row, panel in enumerate(panels):
            limits.setdefault(row, set()).update(filter(np.isfinite, panel.limits))
            by_line = not several and len(panel.lines) > 1
            for trace in _traces(panel, index, run.name, numbers if by_line else None, several):
                trace.showlegend = trace.showlegend and trace.legendgroup not in named
                if trace.showlegend:
                    named.add(str(trace.legendgroup))
                trace.yaxis = f"y{_suffix(row)}"
                figure.add_trace(trace)
            top = 1.0 - row * (height + _ROOM)
            axis: dict[str, Any] = {
                "title": {"text": panel.label, "standoff": 8},
                "domain": [top - height, top],
            }
            if panel.logarithmic:
                axis |= {"type": "log", "exponentformat": "power"}
            if panel.span is not None and not several:
                axis["range"] = list(panel.span)
            figure.update_layout({f"yaxis{_suffix(row)}": axis})
    for row, values in limits.items():
        for value in sorted(values):
            figure.add_shape(
                {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "yref": f"y{_suffix(row)}"}
                | {"y0": value, "y1": value, "line": {"dash": "dash", "color": "#888888"}}
            )
    _shade(figure, runs)
    figure.update_layout(
        height=_FRAME + _PANEL_HEIGHT * rows,
        showlegend=bool(named),
        xaxis={
            "title": {"text": "time [s]"},
            "range": _span(runs),
            "anchor": f"y{_suffix(rows - 1)}",
        },
    )
    return figure


def _suffix(row: int) -> str:
    """Return how Plotly numbers the axis of a row, the first of which has no number."""
    return str(row + 1) if row else ""


def _shade(figure: go.Figure, runs: Sequence[ShownRun]) -> None:
    """Shade the times at which a robot was stopped, at fault or disturbed; once for all runs."""
    halts = [item for run in runs for item in run.charts.halts.items()]
    spans = dict.fromkeys((state, *span) for state, found in halts for span in found.tolist())
    for state, begin, end in spans:
        figure.add_shape(
            {"type": "rect", "xref": "x", "yref": "paper", "y0": 0, "y1": 1, "layer": "below"}
            | {"x0": begin, "x1": end, "line": {"width": 0}, "name": state}
            | {"fillcolor": _HALTS.get(state, "rgba(128,128,128,0.3)")}
        )


def _span(runs: Sequence[ShownRun]) -> list[float]:
    """Return from when to when the runs go [s], with a little room."""
    times = [run.charts.track.moving_time for run in runs]
    first, last = min(time[0] for time in times), max(time[-1] for time in times)
    room = 0.01 * max(last - first, 1e-3)
    return [float(first - room), float(last + room)]


def _traces(
    panel: Panel, index: int, run: str, numbers: dict[str, int] | None, several: bool
) -> list[go.Scatter]:
    """Return the curves of a panel: coloured by the curve's number, or by run if there is none."""
    behind = [line for line in panel.lines if line.background]
    shown = [line for line in panel.lines if not line.background]
    named = several or numbers is not None
    traces = [_background(behind)] if behind else []
    for line in shown:
        number = index if numbers is None else numbers[line.name]
        group = run if numbers is None else line.name
        name = _short(group)
        traces.append(
            go.Scatter(
                x=_small(line.time),
                y=_small(line.values),
                mode="lines",
                line={
                    "color": color(number),
                    "dash": "dash" if numbers is not None and is_dashed(number) else "solid",
                    "width": 1.6,
                    "shape": "hv" if panel.steps else "linear",
                },
                name=name,
                legendgroup=_plain(group),
                showlegend=named,
                hovertemplate=f"{name if named else _plain(line.name)}: %{{y:.5g}}<extra></extra>",
            )
        )
    return traces


def _background(lines: Sequence[Line]) -> go.Scatter:
    """Return the lines behind the others as one curve with gaps, which a browser draws faster."""
    gap = np.full(1, np.nan)
    return go.Scatter(
        x=_small(np.concatenate([part for line in lines for part in (line.time, gap)])),
        y=_small(np.concatenate([part for line in lines for part in (line.values, gap)])),
        mode="lines",
        line={"color": POINT_COLOR if len(lines) <= _FEW else _GREY, "width": 1},
        showlegend=False,
        hoverinfo="skip",
        meta="behind",  # page.js fits the axes to the others
    )


def _steering(found: SteeringMap, maps: Sequence[SteeringMap]) -> go.Figure:
    """Return the map of a policy's turn rate, in the colours that all maps share."""
    most = max(float(np.abs(item.turn_rate).max()) for item in maps)
    figure = go.Figure()
    figure.add_heatmap(
        x=_small(np.degrees(found.theta)),
        y=_small(found.y),
        z=_small(found.turn_rate),
        zmin=-most,
        zmax=most,
        colorscale="RdBu",
        colorbar={"title": {"text": "ω [rad/s]", "side": "right"}, "thickness": 12},
        hovertemplate="y %{y:.2f} m, θ %{x:.0f}°: %{z:.3f} rad/s<extra></extra>",
    )
    figure.update_layout(
        height=_FRAME + 2 * _PANEL_HEIGHT,
        xaxis={"title": {"text": "angle θ to the path [°]"}},
        yaxis={"title": {"text": "distance y from the path [m]"}},
    )
    return figure


def _histogram(key: str, runs: Sequence[ShownRun]) -> go.Figure:
    figure = go.Figure()
    drawn = []
    for index, run in enumerate(runs):
        found = run.charts.histograms.get(key)
        if found is None:
            continue
        drawn.append(found)
        shown = found.counts > 0
        figure.add_bar(
            x=0.5 * (found.edges[1:] + found.edges[:-1])[shown],
            y=found.counts[shown],
            width=float(found.edges[1] - found.edges[0]),
            marker={"color": color(index), "line": {"color": color(index), "width": 1}},
            opacity=0.7 if len(runs) > 1 else 1.0,
            name=_short(run.name),
            hovertemplate="%{x:.3g} ms: %{y} times<extra></extra>",
        )
        figure.update_xaxes(title_text=found.label)
    most = max(int(found.counts.max()) for found in drawn)
    edges = np.concatenate([found.edges for found in drawn])
    # A logarithmic axis shows the one late command beside a million in time.
    figure.update_yaxes(
        title_text="how often",
        type="log",
        exponentformat="power",
        dtick=1,
        range=[-0.3, math.log10(most) + 0.3],
    )
    figure.update_xaxes(range=[float(edges.min()), float(edges.max())])
    figure.update_layout(height=_FRAME + _PANEL_HEIGHT, barmode="overlay", showlegend=len(runs) > 1)
    return figure


def _events(runs: Sequence[ShownRun]) -> go.Figure:
    figure = go.Figure()
    for index, run in enumerate(runs):
        events = run.events
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
            name=_short(run.name),
            hovertemplate="%{x:.2f} s: %{text}<extra></extra>",
            cliponaxis=False,  # the first and the last are at the edge of a narrow figure
        )
    figure.update_yaxes(  # all kinds, so that figures of several reports can be compared
        categoryorder="array",
        categoryarray=list(reversed(KINDS)),
        range=[-0.5, len(KINDS) - 0.5],
        automargin=True,
    )
    figure.update_xaxes(title_text="time [s]", range=_span(runs))
    figure.update_layout(height=_FRAME + _PANEL_HEIGHT, showlegend=len(runs) > 1)
    return figure
