"""Numbers that describe a recorded run of any controller."""

import functools
import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from adp_path_follower import criteria
from adp_path_follower.analysis.costs import COST_HORIZON
from adp_path_follower.analysis.recorded_run import Drive, finite, period_of
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.safety.supervisor import State

_NOISES = 3.0  # times its size from which on something is not noise
_STEADY = (
    f"after the first {criteria.TRANSIENT:g} s, of a run shorter than "
    f"{criteria.TRANSIENT / criteria.TRANSIENT_SHARE:.0f} s after a third"
)


@dataclass(frozen=True)
class Metric:
    """Describes one number."""

    name: str  # in metrics.json and for --require
    unit: str  # empty for a plain number
    meaning: str  # one line
    better: str = "low"  # "low", "high", or empty where neither is


def _rms(values: FloatArray) -> float:
    if not len(values):
        return math.nan
    # Whose square may be beyond 1e308 in a damaged bag.
    largest = float(np.abs(values).max()) or 1.0
    return largest * float(np.sqrt(np.mean((values / largest) ** 2)))


_STATISTICS: dict[str, tuple[str, Callable[[FloatArray], Any]]] = {
    "rms": ("Root mean square of", _rms),
    "mean": ("Mean of", np.mean),
    "median": ("Median of", np.median),
    "p95": ("95 % quantile of", functools.partial(np.quantile, q=0.95)),
    "max": ("Largest value of", np.max),
}


def _statistics(name: str, what: str, unit: str) -> tuple[Metric, ...]:
    return tuple(
        Metric(f"{name}_{statistic}", unit, f"{word} {what}")
        for statistic, (word, _) in _STATISTICS.items()
    )


METRICS = (
    Metric("duration", "s", "Time during which the robot was told to move", ""),
    Metric("distance", "m", "Length of the robot's track", ""),
    Metric("path_covered", "m", "How far it came along the path", ""),
    *_statistics("cross_track", "the distance from the path", "m"),
    *_statistics("heading", "the angle to the path", "rad"),
    Metric("steady_cross_track_rms", "m", f"Like cross_track_rms, {_STEADY}"),
    Metric("steady_cross_track_max", "m", f"Like cross_track_max, {_STEADY}"),
    Metric(
        "settling_time",
        "s",
        f"Until the error [s, y, θ] to the virtual target stays below {criteria.SETTLED:g} in norm",
    ),
    Metric(
        "approach_time",
        "s",
        f"Until the distance stays below {100 * criteria.APPROACHED_SHARE:g} % of that at the "
        f"start, or {1000 * criteria.APPROACHED_LEAST:g} mm",
    ),
    Metric(
        "overshoot",
        "",
        "How far it went to the other side before that, as a share of the distance at the start",
    ),
    Metric("cost", "", f"J = ∫ eᵀQe + uᵀRu over the first {COST_HORIZON:g} s"),
    Metric("optimal_cost", "", "J* of the offline optimum from the same start", ""),
    Metric("cost_ratio", "", "J / J*: 1 is the best that any controller can do"),
    Metric("linear_effort", "m²/s", "∫ v² dt of the commands", ""),
    Metric("angular_effort", "rad²/s", "∫ ω² dt of the commands", ""),
    Metric("linear_variation", "m/s", "Σ |Δv| of the commands: how restless they are", ""),
    Metric("angular_variation", "rad/s", "Σ |Δω| of the commands: how restless they are", ""),
    Metric("command_rate", "Hz", "Commands per second", "high"),
    Metric("command_jitter", "s", "Standard deviation of the time between commands"),
    Metric("command_period_max", "s", "Longest time between two commands"),
    Metric("latency_p50", "s", "Median time from odometry to its command, as recorded"),
    Metric("latency_p99", "s", "99 % of the commands come within this time of their odometry"),
    Metric("bellman_error_rms", "", "Root mean square of the Bellman error at the robot's place"),
    Metric(
        "excitation_min",
        "",
        "Smallest learning certificate; above 0, every weight is determined",
        "high",
    ),
    Metric("messages", "", "Messages in the bag", ""),
)
METRIC_NAMES = tuple(metric.name for metric in METRICS)
_STATE = "time_in_state."


def measure_drive(drive: Drive, costs: Mapping[str, float]) -> dict[str, float]:
    """Return name -> value, NaN if unknown, with the costs that were counted of it."""
    values = dict.fromkeys(METRIC_NAMES, math.nan)
    driving, beside = drive.driving, drive.driving & drive.compared
    time = drive.odometry.time[beside]
    cross = np.abs(drive.projection.cross_track[beside])
    steady = cross[time >= criteria.transient(drive.end)]
    values |= {
        "duration": float(drive.end),
        "distance": drive.motion.distance(driving),
        "path_covered": _covered(drive),
        **_spread("cross_track", cross),
        **_spread("heading", np.abs(drive.projection.heading[beside])),
        "steady_cross_track_rms": _rms(steady),
        "steady_cross_track_max": float(steady.max()) if len(steady) else math.nan,
        "messages": float(sum(drive.run.message_counts.values())),
        "settling_time": _settling_time(drive),
        **approach(time, drive.projection.cross_track[beside], drive.motion.noise),
        **_command_values(drive),
    }
    for key, name, statistic in (
        ("bellman_error", "bellman_error_rms", _rms),
        ("excitation", "excitation_min", lambda found: float(found.min())),
    ):
        if key in drive.learner:
            found = finite(drive.learner[key].values)
            values[name] = statistic(found) if len(found) else math.nan
    return {**values, **costs}


def approach(time: FloatArray, cross_track: FloatArray, noise: float = 0.0) -> dict[str, float]:
    """Return approach time [s] and overshoot, from distances [m] over time [s], shape (N,) each.

    Neither is known of a robot that began on the path, as far as noise [m] tells.
    """
    found = {"approach_time": math.nan, "overshoot": math.nan}
    if not len(time) or abs(cross_track[0]) < max(criteria.APPROACHED_LEAST, _NOISES * noise):
        return found
    inside, start = criteria.has_approached(cross_track), float(cross_track[0])
    taken = criteria.time_to_stay(time, inside)
    found["approach_time"] = taken if math.isfinite(taken) else math.nan
    before = cross_track[: np.flatnonzero(~inside)[-1] + 1]
    other_side = float((-math.copysign(1.0, start) * before).max(initial=0.0))
    found["overshoot"] = other_side / abs(start)
    return found


def _settling_time(drive: Drive) -> float:
    """Return the settling time [s], NaN without a recorded error or where it does not settle."""
    recorded = drive.learner.get("tracking_error")
    if recorded is None:
        return math.nan
    chosen = (recorded.time >= 0.0) & (recorded.time <= drive.end)
    if not chosen.any():
        return math.nan
    time, settled = recorded.time[chosen], criteria.is_settled(recorded.values[chosen])
    if settled.all():  # there was nothing to settle
        return math.nan
    # Since the robot was told to move: the first error may be told of a little later.
    taken = float(time[0]) + criteria.time_to_stay(time, settled)
    return taken if math.isfinite(taken) else math.nan


def time_in_state(drive: Drive) -> dict[str, float]:
    """Return how long the controller was in each state [s]; empty where the bag does not say."""
    spent: dict[str, float] = {}
    for state, begin, end in drive.states:
        spent[state] = spent.get(state, 0.0) + end - begin
    return spent


def _covered(drive: Drive) -> float:
    """Return how far the robot came along its path or paths [m], NaN if no place is known."""
    arc_length, motion = drive.projection.arc_length, drive.motion
    chosen = drive.driving[1:] & drive.driving[:-1] & ~motion.carried[1:]
    lengths = np.array([segment.path.length for segment in drive.segments])
    segment = drive.segment_of_pose
    # Over a cusp to the end of one segment and on along the next, but no farther than was driven.
    over = lengths[segment[:-1]] - arc_length[:-1] + arc_length[1:]
    driven = (np.abs(motion.along) + motion.hidden)[1:]
    same = np.diff(segment) == 0
    steps = finite(np.where(same, np.diff(arc_length), np.clip(over, 0.0, driven))[chosen])
    return float(steps.sum()) if drive.compared.any() else math.nan


def _spread(name: str, values: FloatArray) -> dict[str, float]:
    if not len(values):
        return {}
    return {f"{name}_{statistic}": float(of(values)) for statistic, (_, of) in _STATISTICS.items()}


def _command_values(drive: Drive) -> dict[str, float]:
    """Return what the commands were like while the robot was told to move."""
    time = drive.commands.time
    chosen = (time >= 0.0) & (time <= drive.end)
    commands, period = drive.commands.values[chosen], period_of(drive)
    found: dict[str, float] = {}
    if len(period):
        effort = (commands[:-1] ** 2 * period[:, None]).sum(axis=0)  # held until the next
        variation = np.abs(np.diff(commands, axis=0)).sum(axis=0)
        found = {
            "linear_effort": float(effort[0]),
            "angular_effort": float(effort[1]),
            "linear_variation": float(variation[0]),
            "angular_variation": float(variation[1]),
            "command_rate": float(1.0 / period.mean()),
            "command_jitter": round(float(period.std()), 9),
            "command_period_max": float(period.max()),
        }
    if len(drive.latency):
        p50, p99 = np.quantile(drive.latency, [0.5, 0.99])
        found |= {"latency_p50": float(p50), "latency_p99": float(p99)}
    return found


# Requirements

_COMPARISONS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "<": operator.lt,
    ">": operator.gt,
}


@dataclass(frozen=True)
class Requirement:
    """A limit that a number has to keep."""

    text: str  # as it was given
    name: str  # which number
    comparison: str  # one of < <= > >=
    limit: float  # in the number's unit

    def met(self, values: Mapping[str, float]) -> bool:
        """Return whether a run keeps it; a number that is not known does not."""
        return _COMPARISONS[self.comparison](values.get(self.name, math.nan), self.limit)


def parse_requirement(text: str) -> Requirement:
    """Return the requirement of a text like "cross_track_rms<0.02"; AdpError if it is invalid."""
    match = re.fullmatch(r"\s*([\w. ]+?)\s*(<=|>=|<|>)\s*(\S+)\s*", text)
    if match is None:
        raise AdpError(f"--require '{text}' is not NAME<LIMIT, as in 'cross_track_rms<0.02'")
    name, comparison, limit_text = match.groups()
    if name not in METRIC_NAMES and not name.startswith(_STATE):
        raise AdpError(
            f"--require '{text}' names no metric: there are {', '.join(METRIC_NAMES)} and "
            f"{_STATE}STATE"
        )
    states = [state.value for state in State]
    if name.startswith(_STATE) and name.removeprefix(_STATE) not in states:
        raise AdpError(
            f"--require '{text}' names no state of the controller: there are {', '.join(states)}"
        )
    try:
        limit = float(limit_text)
    except ValueError:
        limit = math.nan
    if math.isnan(limit):
        raise AdpError(f"--require '{text}' has the limit '{limit_text}', which is no number")
    return Requirement(text, name, comparison, limit)


def with_states(values: Mapping[str, float], states: Mapping[str, float]) -> dict[str, float]:
    """Return all numbers that a requirement can name; states that a bag leaves out took no time."""
    known = {**dict.fromkeys((state.value for state in State), 0.0), **states} if states else {}
    return {**values, **{f"{_STATE}{name}": spent for name, spent in known.items()}}
