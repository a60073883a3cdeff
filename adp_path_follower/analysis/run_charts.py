"""The charts of a recorded run, decimated so that they stay small however long the bag is."""

from collections.abc import Callable, Mapping

import numpy as np

from adp_path_follower.analysis.identification.recording import Recording
from adp_path_follower.analysis.identification.response import modelled
from adp_path_follower.analysis.recorded_run import Drive, Timed, period_of
from adp_path_follower.core.control.error_dynamics import feedforward, path_state
from adp_path_follower.core.control.policy import descending_input, saturate
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.model import RobotModel
from adp_path_follower.core.safety.supervisor import State
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.criteria import transient
from adp_path_follower.drawing.charts import (
    Charts,
    Line,
    Panel,
    SteeringMap,
    Track,
    above_zero,
    command_panels,
    drawable,
    histogram,
    line_of,
    path_line,
    track_of,
)

LEARNED = 0.4  # [s] after the first step, for which the second map is
_DISTANCES = np.linspace(-1.0, 1.0, 41)  # [m]
_ANGLES = np.radians(np.linspace(-90.0, 90.0, 41))
_HALTS = {State.WAITING.value, State.STOPPED.value, State.FAULT.value}
_BUCKETS = 1600  # of a line, shared by the bags
_WEIGHT_BUCKETS = 450  # of one of many
_GREY_BUCKETS = 100  # of a weight that is only there for the whole
_NAMED_WEIGHTS = 10
_TRACK_BUCKETS = 500  # of the track, shared by the bags; each point is a mark of its own
_POSES = 2000  # that the robot is moved through, shared by the bags

# Label of a panel -> the recorded numbers that it shows, and half of the least span of its axis.
_PANELS = {
    "times [s]": (("delay [s]", "linear lag [s]", "angular lag [s]"), 0.05),
    "gains": (("k_v", "k_w"), 0.02),
    "bias [rad/m]": (("bias [rad/m]",), 0.02),
}
_AXIS_ROOM = 1.1  # span of an axis as a multiple of what it shows
_RAMPS = ("ramp [m/s^2]", "angular ramp [rad/s^2]")


def charts_of(drive: Drive, bags: int, optimum: FloatArray | None = None) -> Charts:
    """Return the figures of a drive, one of a number of bags, beside its optimum (T, 4)."""
    buckets = max(200, _BUCKETS // bags)

    def line(name: str, timed: Timed, column: int = 0, change: Callable = np.asarray) -> Line:
        return line_of(name, timed.time, change(timed.values[:, column]), buckets)

    found: dict[str, tuple[Panel, ...]] = {}
    if drive.compared.any():
        found["errors"] = _error_panels(drive, buckets)
    if len(drive.commands.time):
        limits = drive.settings.limits if drive.settings is not None else None
        found["commands"] = command_panels(
            line("v", drive.commands), line("ω", drive.commands, 1), limits
        )
    learner = drive.learner
    if "cost" in learner:
        found["cost"] = (Panel("cost to date", (line("cost", learner["cost"]),)),)
    weights = tuple(
        Panel(f"{name} weight", _weight_lines(learner[f"{name}_weights"], bags))
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
    found |= _robot_panels(drive, buckets)
    histograms = {
        key: histogram(label, 1e3 * values)
        for key, label, values in (
            ("period", "time between commands [ms]", period_of(drive)),
            ("latency", "odometry to command [ms]", drive.latency),
        )
        if len(values)
    }
    return Charts(
        _track(drive, bags), found, histograms, _halts(drive), _steering_maps(drive), optimum
    )


def _halts(drive: Drive) -> dict[str, FloatArray]:
    """Return when the controller waited, was stopped or at fault: state -> times (N, 2) [s]."""
    found: dict[str, list[tuple[float, float]]] = {}
    for state, begin, end in drive.states:
        # Before the first command and after the last one there is nothing to shade.
        begin, end = max(begin, 0.0), min(end, drive.end)
        if state in _HALTS and end > begin:
            found.setdefault(state, []).append((begin, end))
    return {state: np.array(spans) for state, spans in found.items()}


def _error_panels(drive: Drive, buckets: int) -> tuple[Panel, ...]:
    """Return distance and angle to the path, and how far the robot is ahead of its target."""
    time, beside = drive.odometry.time, drive.projection
    curves = [
        ("cross-track [mm]", "cross-track", time, 1e3 * beside.cross_track),
        ("heading [rad]", "heading", time, beside.heading),
    ]
    if "tracking_error" in drive.learner:
        error = drive.learner["tracking_error"]
        curves.append(("s to target [m]", "s", error.time, error.values[:, 0]))
    return tuple(
        Panel(label, (line_of(name, at, values, buckets),)) for label, name, at, values in curves
    )


def _weight_lines(weights: Timed, bags: int) -> tuple[Line, ...]:
    """Return the largest weights by name, and the others behind them."""
    # Column by column: a copy of all weights of an hour would take 200 MB.
    size = np.array([np.abs(column).max(initial=0.0) for column in weights.values.T])
    size[~np.isfinite(size)] = np.inf
    named = set(np.argsort(-size)[: max(3, _NAMED_WEIGHTS // bags)].tolist())
    lines = []
    for column in range(weights.values.shape[1]):
        label = weights.labels[column] if column < len(weights.labels) else str(column + 1)
        background = column not in named
        count = (_GREY_BUCKETS if background else _WEIGHT_BUCKETS) // bags
        values = weights.values[:, column]
        lines.append(line_of(label, weights.time, values, count, background))
    return tuple(sorted(lines, key=lambda line: not line.background))


def _track(drive: Drive, bags: int) -> Track:
    """Return the track, with every peak of the distance from the path, and its motion."""
    shown, beside = drive.in_one_frame, drive.compared.any()
    time, poses = drive.odometry.time[shown], drive.odometry.values[shown, :3]
    steady = drive.driving & drive.compared & (drive.odometry.time >= transient(drive.end))
    target = None
    if beside and "target" in drive.learner and len(drive.learner["target"].time):
        known, places = drive.learner["target"].time, drive.learner["target"].values[:, :2].T
        columns = (np.interp(time, known, drawable(row), np.nan, np.nan) for row in places)
        target = np.column_stack([*columns])
    return track_of(
        path_line([segment.path for segment in drive.segments if beside], bags),
        time,
        poses,
        drive.projection.cross_track[shown],
        target=target,
        steady=steady[shown],
        points=max(200, _TRACK_BUCKETS // bags),
        samples=max(500, _POSES // bags),
    )


def _steering_maps(drive: Drive) -> tuple[SteeringMap, ...]:
    """Return the policy's map at the first recorded step and `LEARNED` later.

    Empty where the bag has no actor weights, no settings that fit them, or no place beside a path.
    """
    weights, settings = drive.learner.get("actor_weights"), drive.settings
    if weights is None or settings is None or not len(weights.time):
        return ()
    if weights.values.shape[1] != len(settings.learning.value_basis.labels):
        return ()
    place = int(np.searchsorted(weights.time, weights.time[0] + LEARNED))
    chosen = (0, min(place, len(weights.time) - 1))
    if not np.isfinite(weights.values[list(chosen)]).all() or not drive.compared.all():
        return ()
    return tuple(
        SteeringMap(
            _DISTANCES,
            _ANGLES,
            _turn_rates(drive, settings, weights.values[step], float(weights.time[step])),
        )
        for step in chosen
    )


def _turn_rates(drive: Drive, settings: Settings, actor: FloatArray, time: float) -> FloatArray:
    """Return the commanded turn rate [rad/s] at each y and theta, with s = 0, shape (Y, T).

    u = -1/2 R^-1 g^T sigma'^T Wa of equation (2), within the limits, where the robot was then.
    """
    row = min(int(np.searchsorted(drive.odometry.time, time)), len(drive.odometry.time) - 1)
    path = drive.segments[int(drive.segment_of_pose[row])].path
    arc_length = drive.projection.arc_length[row]
    y, theta = np.meshgrid(_DISTANCES, _ANGLES, indexing="ij")
    phi = np.broadcast_to(path_state(arc_length, settings.target), y.shape)
    zeta = np.stack([np.zeros_like(y), y, theta, phi], axis=-1)
    by_s, by_y, by_theta, _ = settings.learning.value_basis.expansion(zeta).slope(actor)
    descent = np.stack([np.cos(theta) * by_s + np.sin(theta) * by_y, by_theta], axis=-1)
    ahead = feedforward(path.curvature(arc_length), settings.target.desired_speed)
    ahead = np.broadcast_to(ahead, descent.shape)
    inverse_cost = settings.cost.inverse_input_cost()
    wanted = saturate(descending_input(descent, inverse_cost), ahead, settings.limits)
    return np.asarray((wanted + ahead)[..., 1])


def _robot_panels(drive: Drive, buckets: int) -> dict[str, tuple[Panel, ...]]:
    """Return the parameters over time, and measured beside modelled velocities, where recorded."""
    told = drive.learner.get("robot_model")
    names = [name for shown, _ in _PANELS.values() for name in shown]
    if told is None or not {*names, *_RAMPS} <= {*told.labels} or not len(told.time):
        return {}
    if told.values.shape[1] != len(told.labels):
        return {}
    columns = dict(zip(told.labels, told.values.T, strict=True))
    panels = []
    for label, (shown, least) in _PANELS.items():
        lines, drawn = [], []
        for name in shown:
            values, edges = columns[name], _two_deviations(columns, name)
            lines += [line_of(name, told.time, edge, buckets, background=True) for edge in edges]
            lines.append(line_of(name.partition(" [")[0], told.time, values, buckets))
            drawn += [values, *(edge[-1:] for edge in edges)]
        panels.append(Panel(label, tuple(lines), span=_axis_around(np.concatenate(drawn), least)))
    found = {"robot_model": tuple(panels)}
    *numbers, ramp, angular_ramp = (float(columns[name][-1]) for name in (*names[:3], *_RAMPS))
    if len(drive.commands.time) and np.isfinite(numbers).all():
        time, values = drive.odometry.time, drive.odometry.values
        sent, commands = drive.commands.time, drive.commands.values
        poses, encoders = values[:, :3], values[:, 3:]
        recording = Recording(sent, commands, time, poses, encoders, False, sent[:0], ())
        delay, lag, angular_lag = numbers
        model = RobotModel(delay, lag, angular_lag, ramp=ramp, angular_ramp=angular_ramp)
        answer = modelled(recording, model)
        found["robot_velocity"] = tuple(
            Panel(
                label,
                (
                    line_of("measured", time, encoders[:, part], buckets),
                    line_of("model", time, answer[:, part], buckets),
                ),
            )
            for part, label in enumerate(("v [m/s]", "ω [rad/s]"))
        )
    return found


def _two_deviations(columns: Mapping[str, FloatArray], name: str) -> list[FloatArray]:
    """Return two deviations below and above a number; nothing if driving did not narrow them."""
    spread = columns.get(f"deviation of {name}", np.zeros(len(columns[name])))
    narrowed = bool((spread < spread[0]).any())
    return [columns[name] + sign * 2.0 * spread for sign in (-1.0, 1.0)] if narrowed else []


def _axis_around(values: FloatArray, least: float) -> tuple[float, float] | None:
    """Return the axis of values with their last deviations, for the first ones may be huge."""
    if not np.isfinite(values).all():
        return None
    middle = 0.5 * float(values.min() + values.max())
    half = max(_AXIS_ROOM * (float(values.max()) - middle), least)
    return middle - half, middle + half
