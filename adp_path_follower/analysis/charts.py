"""What the figures of analysed bags show, whoever draws them: page or PNG.

Everything here is decimated, so that it stays small however long the bag is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from adp_path_follower.analysis.bag_metrics import TRANSIENT
from adp_path_follower.analysis.decimation import extremes
from adp_path_follower.analysis.drive import Drive, Timed, period_of
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path

_BUCKETS = 2000  # of a line, shared by the bags
_GREY_BUCKETS = 200  # of a weight that is only there for the whole
_NAMED_WEIGHTS = 10
_PATH_POINTS = 4000  # of all paths, shared by the bags
_LEAST_PATH_POINTS = 12  # of each path, however many there are
_LEAST_DISTANCE = 1e-6  # [m] that colours are told apart for
_POSES = 4000  # that the robot is moved through, shared by the bags
_BINS = 60
_GREATEST = 1e30  # that is drawn; the page has single precision, and the axes need room beyond


@dataclass(frozen=True)
class Line:
    """A curve: time [s] and values, shape (N,) each; a background one is drawn in grey."""

    name: str
    time: FloatArray
    values: FloatArray
    background: bool = False


@dataclass(frozen=True)
class Panel:
    """Curves over one axis.

    Attributes:
        label: Of the axis, with its unit.
        lines: The curves.
        limits: Values that the curves may not leave.
        logarithmic: Whether the axis is.

    """

    label: str
    lines: tuple[Line, ...]
    limits: tuple[float, ...] = ()
    logarithmic: bool = False


@dataclass(frozen=True)
class Histogram:
    """How often which value was there: bins between `edges` (N + 1) and `counts` (N,)."""

    label: str
    edges: FloatArray
    counts: np.ndarray


@dataclass(frozen=True)
class Track:
    """Where the robot drove.

    Attributes:
        path: Positions along all paths, one after the other with a row of NaN between, (N, 2).
        time: Of the points of the track [s], shape (T,).
        position: x, y, shape (T, 2).
        cross_track: Distance from the path with its sign [m], shape (T,).
        color_limit: Distance from which on all have one colour [m].
        moving_time: Times at which the whole is known where it was [s], shape (M,).
        robot: x, y, theta then, shape (M, 3).
        target: x, y of the virtual target then, shape (M, 2); NaN where it was not recorded.

    """

    path: FloatArray
    time: FloatArray
    position: FloatArray
    cross_track: FloatArray
    color_limit: float
    moving_time: FloatArray
    robot: FloatArray
    target: FloatArray


@dataclass(frozen=True)
class Charts:
    """The figures of one bag: key -> panels or histogram."""

    track: Track
    panels: dict[str, tuple[Panel, ...]]
    histograms: dict[str, Histogram]


def charts_of(drive: Drive, bags: int) -> Charts:
    """Return the figures of a drive, one of a number of bags."""
    buckets = max(200, _BUCKETS // bags)

    def line(name: str, timed: Timed, column: int = 0, change: Callable = np.asarray) -> Line:
        return _line(name, timed.time, change(timed.values[:, column]), buckets)

    found: dict[str, tuple[Panel, ...]] = {"errors": _error_panels(drive, buckets)}
    if len(drive.commands.time):
        limits = drive.settings.limits if drive.settings is not None else None
        found["commands"] = (
            Panel(
                "v [m/s]",
                (line("v", drive.commands),),
                () if limits is None else (limits.min_linear_vel, limits.max_linear_vel),
            ),
            Panel(
                "ω [rad/s]",
                (line("ω", drive.commands, 1),),
                () if limits is None else (-limits.max_angular_vel, limits.max_angular_vel),
            ),
        )
    learner = drive.learner
    if "cost" in learner:
        found["cost"] = (Panel("cost to date", (line("cost", learner["cost"]),)),)
    weights = tuple(
        Panel(f"{name} weight", _weight_lines(learner[f"{name}_weights"], buckets, bags))
        for name in ("critic", "actor")
        if f"{name}_weights" in learner
    )
    if weights:
        found["weights"] = weights
    if "bellman_error" in learner:
        error = line("|δ|", learner["bellman_error"], change=_size)
        found["bellman_error"] = (Panel("|Bellman error|", (error,), logarithmic=True),)
    if "excitation" in learner:
        found["excitation"] = (Panel("certificate", (line("certificate", learner["excitation"]),)),)
    histograms = {
        key: _histogram(label, 1e3 * values)
        for key, label, values in (
            ("period", "time between commands [ms]", period_of(drive)),
            ("latency", "odometry to command [ms]", drive.latency),
        )
        if len(values)
    }
    return Charts(_track(drive, bags), found, histograms)


def _error_panels(drive: Drive, buckets: int) -> tuple[Panel, ...]:
    """Return distance and angle to the path, and how far the robot is ahead of its target."""
    time, beside = drive.odometry.time, drive.projection
    panels = [
        Panel("cross-track [m]", (_line("cross-track", time, beside.cross_track, buckets),)),
        Panel("heading [rad]", (_line("heading", time, beside.heading, buckets),)),
    ]
    if "tracking_error" in drive.learner:
        error = drive.learner["tracking_error"]
        panels.append(
            Panel("s to target [m]", (_line("s", error.time, error.values[:, 0], buckets),))
        )
    return tuple(panels)


def _weight_lines(weights: Timed, buckets: int, bags: int) -> tuple[Line, ...]:
    """Return the largest weights by name, and the others behind them."""
    # Column by column: a copy of all weights of an hour would take 200 MB.
    size = np.array([np.abs(column).max(initial=0.0) for column in weights.values.T])
    size[~np.isfinite(size)] = np.inf
    named = set(np.argsort(-size)[: max(3, _NAMED_WEIGHTS // bags)].tolist())
    lines = []
    for column in range(weights.values.shape[1]):
        label = weights.labels[column] if column < len(weights.labels) else str(column + 1)
        background = column not in named
        count = _GREY_BUCKETS // bags if background else buckets
        values = weights.values[:, column]
        lines.append(_line(label, weights.time, values, count, background))
    return tuple(sorted(lines, key=lambda line: not line.background))


def _line(
    name: str, time: FloatArray, values: FloatArray, buckets: int, background: bool = False
) -> Line:
    values = _drawable(values)
    kept = extremes(values, buckets)
    return Line(name, time[kept], values[kept], background)


def _drawable(values: FloatArray) -> FloatArray:
    """Return values with a gap where a damaged message held what no figure can show."""
    return np.where(np.abs(values) <= _GREATEST, values, np.nan)


def _size(values: FloatArray) -> FloatArray:
    return np.asarray(np.maximum(np.abs(values), 1e-16))  # a logarithmic axis has no zero


def _histogram(label: str, values: FloatArray) -> Histogram:
    values = values[np.isfinite(values)]
    # Even where all values are the same but for rounding the bins have a width to be seen, and the
    # usual value is in the middle of one: at an edge, rounding would tear it apart.
    usual = float(np.median(values))
    least = max(0.05 * abs(usual), 0.05)
    low, high = min(float(values.min()), usual - least), max(float(values.max()), usual + least)
    width = (high - low) / _BINS
    first, last = math.floor((low - usual) / width), math.ceil((high - usual) / width)
    edges = np.asarray(usual + width * (np.arange(first, last + 2) - 0.5), dtype=float)
    return Histogram(label, edges, np.histogram(values, edges)[0])


def _track(drive: Drive, bags: int) -> Track:
    """Return the track, with every peak of the distance from the path, and its motion."""
    time, poses = drive.odometry.time, drive.odometry.values[:, :3]
    kept = extremes(drive.projection.cross_track, max(200, 1500 // bags))
    uniform = np.linspace(0, len(time) - 1, min(len(time), max(500, _POSES // bags)))
    moving = np.unique(uniform.astype(int))
    target = np.full((len(moving), 2), np.nan)
    if "target" in drive.learner and len(drive.learner["target"].time):
        recorded = drive.learner["target"]
        order = np.argsort(recorded.time, kind="stable")
        for column in (0, 1):
            target[:, column] = np.interp(
                time[moving],
                recorded.time[order],
                _drawable(recorded.values[order, column]),
                left=np.nan,
                right=np.nan,
            )
    return Track(
        _path_line([segment.path for segment in drive.segments], bags),
        time[kept],
        poses[kept, :2],
        drive.projection.cross_track[kept],
        _color_limit(drive),
        time[moving],
        poses[moving],
        target,
    )


def _color_limit(drive: Drive) -> float:
    """Return the distance from the path that 95 % of a run are below [m].

    In the first seconds the robot may be hundreds of times farther away than later, which would
    leave one colour for all the rest: where there is a rest that is as long, they do not count.
    """
    chosen = drive.driving
    if drive.end >= 2.0 * TRANSIENT:
        chosen = chosen & (drive.odometry.time >= TRANSIENT)
    distance = np.abs(drive.projection.cross_track[chosen])
    return max(float(np.quantile(distance, 0.95)) if len(distance) else 0.0, _LEAST_DISTANCE)


def _path_line(paths: Sequence[Path], bags: int) -> FloatArray:
    """Return positions along all paths as one line with gaps, shape (N, 2).

    However many there are, each keeps a few points, so that its shape is to be seen.
    """
    spacing = max(0.05, sum(path.length for path in paths) * bags / _PATH_POINTS)
    gap = np.full((1, 2), np.nan)
    pieces = []
    for path in paths:
        finest = max(0.05, path.length / _LEAST_PATH_POINTS)
        pieces += [path.points(min(spacing, finest))[:, :2], gap]
    return np.concatenate(pieces[:-1])
