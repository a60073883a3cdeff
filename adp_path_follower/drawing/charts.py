"""Data of charts, for the page and for PNG files, decimated to stay small for any bag."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import LimitSettings

_PATH_POINTS = 4000  # of all paths, shared by the bags
_LEAST_PATH_POINTS = 12  # of each path, however many there are
_BINS = 60
KINDS = ("state", "fault", "warning", "parameter", "path")
_GAP, _GAP_PERIODS = 0.25, 5.0  # [s] and periods without a value that leave a gap
_LEAST_DISTANCE = 1e-4  # [m] at which colours end at least: nobody sees less
_GREATEST = 1e30  # that is drawn; the page has single precision, and the axes need room beyond


@dataclass(frozen=True)
class Event:
    """Something that happened at a time [s]; the kind is one of `KINDS`."""

    time: float
    kind: str
    text: str


@dataclass(frozen=True)
class Line:
    """A curve: time [s] and values, shape (N,) each; a background one is drawn in grey."""

    name: str
    time: FloatArray
    values: FloatArray
    background: bool = False


@dataclass(frozen=True)
class Panel:
    """Curves over one axis."""

    label: str  # name of the axis, with its unit
    lines: tuple[Line, ...]  # the curves
    limits: tuple[float, ...] = ()  # values that the curves may not leave
    logarithmic: bool = False  # whether the axis is
    steps: bool = False  # whether a value holds until the next
    span: tuple[float, float] | None = None  # of the axis; as far as the curves go if None


@dataclass(frozen=True)
class Histogram:
    """How often which value was there: bins between `edges` (N + 1) and `counts` (N,)."""

    label: str
    edges: FloatArray
    counts: np.ndarray


@dataclass(frozen=True)
class Track:
    """Where the robot drove."""

    # Positions along all paths, one after the other with a row of NaN between, (N, 2).
    path: FloatArray
    time: FloatArray  # time of each point of the track [s], shape (T,)
    position: FloatArray  # x, y, shape (T, 2)
    cross_track: FloatArray  # distance from the path with its sign [m], shape (T,)
    color_limit: float  # distance from which on all have one colour [m]
    moving_time: FloatArray  # times at which the whole is known where it was [s], shape (M,)
    robot: FloatArray  # x, y, theta then, shape (M, 3)
    # x, y of the virtual target then, shape (M, 2); NaN where it was not recorded.
    target: FloatArray


@dataclass(frozen=True)
class SteeringMap:
    """The turn rate that a policy commands beside the path: values (len(y), len(theta))."""

    y: FloatArray  # distance from the path, positive to the left [m]
    theta: FloatArray  # angle to the path [rad]
    turn_rate: FloatArray  # [rad/s]


@dataclass(frozen=True)
class Charts:
    """The figures of one run: key -> panels, histogram or map."""

    track: Track
    panels: dict[str, tuple[Panel, ...]]
    histograms: dict[str, Histogram] = field(default_factory=dict)
    # When the robot was stopped, at fault or disturbed: state -> from and until [s], shape (N, 2).
    halts: dict[str, FloatArray] = field(default_factory=dict)
    # The policy at its first step and when it has been learned for a moment; empty if unknown.
    steering: tuple[SteeringMap, ...] = ()
    # The best motion from the same start: time [s], x, y [m], theta [rad], shape (T, 4).
    optimum: FloatArray | None = None


@dataclass(frozen=True)
class ShownRun:
    """A run as a page shows it."""

    name: str
    charts: Charts
    events: tuple[Event, ...]


@dataclass(frozen=True)
class ReferenceMotion:
    """An optimal motion that a run is compared with."""

    time: FloatArray  # shape (N,) [s]
    error: FloatArray  # e = [s, y, theta], shape (N, 3)
    modified_input: FloatArray  # u = [v_e, w_e], shape (N, 2)
    position: FloatArray | None = None  # x, y in the world [m], shape (N, 2), where it is known


@dataclass(frozen=True)
class RunView:
    """The data of one run that the figures show."""

    time: FloatArray  # time of each control step [s], shape (T,)
    path: FloatArray  # positions along the path, shape (P, 2)
    track: FloatArray  # x, y, theta of the robot, shape (T, 3)
    target: FloatArray  # x, y of the virtual target, shape (T, 2)
    error: FloatArray  # e, shape (T, 3)
    modified_input: FloatArray  # u, shape (T, 2)
    weight_time: FloatArray  # time of each row of the weights [s], shape (W,)
    critic_weights: FloatArray  # shape (W, L)
    actor_weights: FloatArray  # shape (W, L)
    labels: tuple[str, ...]  # names of the terms of the basis, length L


def curve_numbers(panels: Sequence[Panel]) -> dict[str, int]:
    """Return the number of each named curve: curves of one name have one colour in all panels."""
    shared = [panel for panel in panels if len(panel.lines) > 1]
    names = [line.name for panel in shared for line in panel.lines if not line.background]
    return {name: number for number, name in enumerate(dict.fromkeys(names))}


def line_of(
    name: str,
    time: FloatArray,
    values: FloatArray,
    buckets: int,
    background: bool = False,
) -> Line:
    """Return the curve through values (N,) at times (N,) with about 2 `buckets` points.

    The curve has a gap where for much longer than usual no value came.
    """
    values, periods = drawable(values), np.diff(time)
    usual = periods[np.isfinite(periods)]
    longest = max(_GAP, _GAP_PERIODS * float(np.median(usual))) if len(usual) else _GAP
    gaps = np.flatnonzero(periods > longest)
    kept = np.unique(np.concatenate([extremes(values, buckets), gaps, gaps + 1]))
    behind = np.searchsorted(kept, gaps) + 1
    return Line(
        name,
        np.insert(time[kept], behind, time[gaps]),
        np.insert(values[kept], behind, np.nan),
        background,
    )


def command_panels(linear: Line, angular: Line, limits: LimitSettings | None) -> tuple[Panel, ...]:
    """Return the panels of v and ω, within limits where these are known."""
    edges: list[tuple[float, ...]] = [(), ()]
    if limits is not None:
        edges[0] = limits.min_linear_vel, limits.max_linear_vel
        edges[1] = -limits.max_angular_vel, limits.max_angular_vel
    return (
        Panel("v [m/s]", (linear,), edges[0], steps=True),
        Panel("ω [rad/s]", (angular,), edges[1], steps=True),
    )


def track_of(
    path: FloatArray,
    time: FloatArray,
    poses: FloatArray,
    cross_track: FloatArray,
    *,
    target: FloatArray | None = None,
    steady: np.ndarray,
    points: int,
    samples: int,
) -> Track:
    """Return the track through poses (N, 3) with every peak of its distance from the path.

    `path` are the positions of the path's line, `target` those of the virtual target at N times.
    Colours end at the distance that 95 % of the `steady` poses (N,) are below.
    """
    kept = extremes(cross_track, points)
    moving = np.unique(np.linspace(0, len(time) - 1, min(len(time), samples)).astype(int))
    beside = np.full((len(time), 2), np.nan) if target is None else target
    distance = np.abs(cross_track[steady])
    limit = float(np.quantile(distance, 0.95)) if len(distance) else 0.0
    return Track(
        path,
        time[kept],
        poses[kept, :2],
        cross_track[kept],
        max(limit, _LEAST_DISTANCE),
        time[moving],
        poses[moving],
        beside[moving],
    )


def rounded_up(value: float) -> float:
    """Return a positive value rounded up to a number with at most two digits."""
    power = 10.0 ** math.floor(math.log10(value))
    least = value / power - 1e-9
    return power * next(step for step in (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 10.0) if step >= least)


def drawable(values: FloatArray) -> FloatArray:
    """Return values with a gap where a damaged message held what no figure can show."""
    return np.where(np.abs(values) <= _GREATEST, values, np.nan)


def above_zero(values: FloatArray) -> FloatArray:
    """Return absolute values that a logarithmic axis can show, same shape."""
    return np.asarray(np.maximum(np.abs(values), 1e-16))  # a logarithmic axis has no zero


def histogram(label: str, values: FloatArray) -> Histogram:
    """Return the histogram of the finite ones of values (N,)."""
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


def path_line(paths: Sequence[Path], bags: int) -> FloatArray:
    """Return positions along all paths as one line with gaps, (N, 2); each keeps a few points."""
    spacing = max(0.05, sum(path.length for path in paths) * bags / _PATH_POINTS)
    gap = np.full((1, 2), np.nan)
    pieces = [gap]  # also where there is no path
    for path in paths:
        finest = max(0.05, path.length / _LEAST_PATH_POINTS)
        pieces += [path.points(min(spacing, finest))[:, :2], gap]
    return np.concatenate(pieces[1:-1] or pieces)


def extremes(values: FloatArray, buckets: int) -> np.ndarray:
    """Return increasing indices of the values (N,) to keep so that a figure shows every peak.

    These are each bucket's least and greatest finite values, the first and the last of all.
    """
    count = len(values)
    if count <= 2 * buckets:
        return np.arange(count)
    width = -(-count // buckets)
    rows = -(-count // width)
    sound = np.isfinite(values)

    def places(fill: float, chosen: str) -> np.ndarray:
        padded = np.full(rows * width, fill)
        padded[:count] = np.where(sound, values, fill)
        within = getattr(padded.reshape(rows, width), chosen)(axis=1)
        return np.asarray(np.arange(rows) * width + within)

    kept = np.concatenate(
        [places(np.inf, "argmin"), places(-np.inf, "argmax"), np.array([0, count - 1])]
    )
    return np.unique(kept[kept < count])
