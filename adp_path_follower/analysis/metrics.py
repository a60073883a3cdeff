"""Numbers that describe a run."""

from __future__ import annotations

import importlib.resources
import json
import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.bags.reader import Run
from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.cost import MotionCost
from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.simulation import PAPER_START
from adp_path_follower.study.replay.replay import Replay

COST_HORIZON = 30.0  # [s] over which the cost of a run is compared
_TRANSIENT = 10.0  # [s] after which the tracking error counts
_SETTLED = 0.02  # of the initial error


@dataclass(frozen=True)
class ReferenceMotion:
    """An optimal motion that a run is compared with.

    Attributes:
        cost: J*.
        time: Shape (N,) [s].
        error: e = [s, y, theta], shape (N, 3).
        modified_input: u = [v_e, w_e], shape (N, 2).
        position: x, y in the world [m], shape (N, 2), where it is known.

    """

    cost: float
    time: FloatArray
    error: FloatArray
    modified_input: FloatArray
    position: FloatArray | None = None


def paper_optimum() -> ReferenceMotion:
    """Return the optimum from the paper's start, which comes with the package."""
    file = importlib.resources.files("adp_path_follower") / "data" / "paper_optimum.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    return ReferenceMotion(
        cost=float(content["cost"]),
        time=np.array(content["t"]),
        error=np.array(content["e"]),
        modified_input=np.array(content["u"]),
    )


@dataclass(frozen=True)
class RunMetrics:
    """Summary of a run; a number that the run is too short for is NaN.

    Attributes:
        duration: Time from the first to the last control step [s].
        cost: J over the first 30 s, along the true motion.
        optimal_cost: J* from the same start, NaN where it is not known.
        cross_track_rms: RMS of y after 10 s [m].
        cross_track_max: Largest |y| after 10 s [m].
        settling_time: Time after which |e| stays below 2 % of its start [s].
        excitation_min: Smallest certificate during the run.
        control_rate: Control steps per second of the run's time [Hz].
        commands: Number of control steps.
        identical_commands: How many of them `PathFollower` repeats to the last bit.
        messages: Number of messages in the bag.

    """

    duration: float
    cost: float
    optimal_cost: float
    cross_track_rms: float
    cross_track_max: float
    settling_time: float
    excitation_min: float
    control_rate: float
    commands: int
    identical_commands: int
    messages: int

    @property
    def cost_ratio(self) -> float:
        """Return J / J*."""
        return self.cost / self.optimal_cost


def measure(run: Run, replay: Replay) -> RunMetrics:
    """Return the summary of a run and its replay."""
    time = (replay.stamp - replay.stamp[0]) * 1e-9
    error = np.array([output.error for output in replay.outputs])
    late = np.abs(error[time >= _TRANSIENT, 1])
    size = np.linalg.norm(error, axis=1)
    outside = np.flatnonzero(size >= _SETTLED * size[0])
    last = int(outside[-1]) if len(outside) else -1
    duration = float(time[-1])
    follower = replay.follower
    known_optimum = is_paper_problem(
        follower.settings, follower.path, float(replay.outputs[0].arc_length), error[0]
    )
    series = run.series.get("excitation")
    known = np.zeros(0) if series is None else series.values[np.isfinite(series.values)]
    return RunMetrics(
        duration=duration,
        cost=cost_over_horizon(
            follower.settings,
            follower.path,
            time,
            replay.pose,
            replay.recorded,
            np.array([float(output.arc_length) for output in replay.outputs]),
        ),
        optimal_cost=paper_optimum().cost if known_optimum else math.nan,
        cross_track_rms=float(np.sqrt(np.mean(late**2))) if len(late) else math.nan,
        cross_track_max=float(late.max()) if len(late) else math.nan,
        settling_time=float(time[last + 1]) if last + 1 < len(time) else math.nan,
        excitation_min=float(known.min()) if len(known) else math.nan,
        control_rate=(len(time) - 1) / duration if duration > 0.0 else math.nan,
        commands=len(time),
        identical_commands=int(replay.identical.sum()),
        messages=sum(run.message_counts.values()),
    )


def cost_over_horizon(
    settings: Settings,
    path: Path,
    time: FloatArray,
    poses: FloatArray,
    commands: FloatArray,
    arc_lengths: FloatArray,
) -> float:
    """Return J over the horizon, from each pose along the command that followed it.

    Args:
        settings: Give cost and target.
        path: The path that was followed.
        time: Time of each control step since the first [s], shape (N,).
        poses: x, y, theta at each step, shape (N, 3).
        commands: [v, w] of each step, shape (N, 2).
        arc_lengths: Of the virtual target at each step [m], shape (N,).

    Returns:
        J, NaN where the run is shorter than the horizon.

    """
    if not len(time) or time[-1] < COST_HORIZON - 1e-6:
        return math.nan
    total, motion_cost = 0.0, MotionCost(settings, path, SpeedProfile(path, settings))
    for step in np.flatnonzero(time[:-1] < COST_HORIZON - 1e-6):
        spent, _ = motion_cost(
            poses[step],
            commands[step],
            arc_lengths[step],
            float(time[step + 1] - time[step]),
        )
        total += float(spent)
    return total


def is_paper_problem(
    settings: Settings, path: Path, arc_length: float, first_error: FloatArray
) -> bool:
    """Return whether the optimum that comes with the package is the one of this run.

    Args:
        settings: The controller's.
        path: The path that was followed.
        arc_length: Where on it the virtual target started [m].
        first_error: The error [s, y, theta] at the start.

    """
    standard = build(Settings, {})
    same_problem = settings.target == standard.target and settings.cost == standard.cost
    place = np.array([arc_length, path.length])
    return bool(
        same_problem
        and _within_limits(paper_optimum(), settings)
        and np.allclose(place, [0.0, lissajous().length], atol=1e-3)
        and np.allclose(first_error, PAPER_START, atol=1e-6)
    )


def _within_limits(optimum: ReferenceMotion, settings: Settings) -> bool:
    """Return whether limits would not have changed an optimum on a straight path."""
    feedforward = error_dynamics.feedforward(np.zeros(len(optimum.time)), settings.target)
    wanted = optimum.modified_input
    return bool(np.allclose(saturate(wanted, feedforward, settings.limits), wanted))
