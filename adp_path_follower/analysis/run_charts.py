"""The charts of a recorded run, decimated so that they stay small however long the bag is."""

from collections.abc import Callable

import numpy as np

from adp_path_follower.analysis.recorded_run import Drive, Timed, period_of
from adp_path_follower.criteria import transient
from adp_path_follower.drawing.charts import (
    Charts,
    Line,
    Panel,
    Track,
    above_zero,
    drawable,
    extremes,
    histogram,
    line_of,
    path_line,
)

_BUCKETS = 2000  # of a line, shared by the bags
_GREY_BUCKETS = 200  # of a weight that is only there for the whole
_NAMED_WEIGHTS = 10
_LEAST_DISTANCE = 1e-6  # [m] that colours are told apart for
_POSES = 4000  # that the robot is moved through, shared by the bags


def charts_of(drive: Drive, bags: int) -> Charts:
    """Return the figures of a drive, one of a number of bags."""
    buckets = max(200, _BUCKETS // bags)

    def line(name: str, timed: Timed, column: int = 0, change: Callable = np.asarray) -> Line:
        return line_of(name, timed.time, change(timed.values[:, column]), buckets)

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
        error = line("|δ|", learner["bellman_error"], change=above_zero)
        found["bellman_error"] = (Panel("|Bellman error|", (error,), logarithmic=True),)
    if "excitation" in learner:
        found["excitation"] = (Panel("certificate", (line("certificate", learner["excitation"]),)),)
    histograms = {
        key: histogram(label, 1e3 * values)
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
        Panel("cross-track [m]", (line_of("cross-track", time, beside.cross_track, buckets),)),
        Panel("heading [rad]", (line_of("heading", time, beside.heading, buckets),)),
    ]
    if "tracking_error" in drive.learner:
        error = drive.learner["tracking_error"]
        panels.append(
            Panel("s to target [m]", (line_of("s", error.time, error.values[:, 0], buckets),))
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
        lines.append(line_of(label, weights.time, values, count, background))
    return tuple(sorted(lines, key=lambda line: not line.background))


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
                drawable(recorded.values[order, column]),
                left=np.nan,
                right=np.nan,
            )
    return Track(
        path_line([segment.path for segment in drive.segments], bags),
        time[kept],
        poses[kept, :2],
        drive.projection.cross_track[kept],
        _color_limit(drive),
        time[moving],
        poses[moving],
        target,
    )


def _color_limit(drive: Drive) -> float:
    """Return the distance [m] that 95 % of a run after its far-away beginning are below."""
    chosen = drive.driving & (drive.odometry.time >= transient(drive.end))
    distance = np.abs(drive.projection.cross_track[chosen])
    return max(float(np.quantile(distance, 0.95)) if len(distance) else 0.0, _LEAST_DISTANCE)
