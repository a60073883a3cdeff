"""Numbers that describe a run."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.bags.reader import Run
from adp_path_follower.study.optimum.reference import (
    cost_over_horizon,
    is_paper_problem,
    paper_optimum,
)
from adp_path_follower.study.replay.replay import Replay

_TRANSIENT = 10.0  # [s] after which the tracking error counts


_SETTLED = 0.02  # of the initial error


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
