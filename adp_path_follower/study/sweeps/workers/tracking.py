"""How near the robots keep to the path, looked at while they drive: nothing is stored."""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower import criteria
from adp_path_follower.core.control.interface import ControlOutput
from adp_path_follower.core.geometry import FloatArray, tracking_error
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.nearest import beside

_LAST_SHARE = 0.2  # of a run: its end
_SAMPLING = 0.05  # [s] between two looks
_LONGEST_STEP = 0.5  # [m] of the search for the place beside the robot, from the target's on


@dataclass(frozen=True)
class Tracking:
    """The tracking of B runs; places and angles are the true ones."""

    cross_track_rms: FloatArray  # RMS distance from the path after the transient [m], shape (B,)
    cross_track_max: FloatArray  # greatest distance then [m], shape (B,)
    # Until |e| to the virtual target stays below 0.05 [s], infinite where it does not, shape (B,).
    settling_time: FloatArray
    # Whether the run stays within 0.5 m of the path, and within a right angle of its direction,
    # over the last fifth of its time, shape (B,).
    ends_on_path: np.ndarray


class TrackingMeter:
    """Looks at B runs at 20 Hz; its `observe` is what `simulate` calls."""

    def __init__(self, path: Path, runs: int, duration: float, period: float) -> None:
        """Prepare for runs of a duration [s] with control steps of a period [s]."""
        self._path = path
        self._stride = max(1, round(_SAMPLING / period))
        self._period = period
        self._counted_from = criteria.transient(duration)
        self._end_from = (1.0 - _LAST_SHARE) * duration
        self._count = 0
        self._squares = np.zeros(runs)
        self._largest = np.zeros(runs)
        self._unsettled = np.full(runs, -math.inf)
        self._ends_on_path = np.ones(runs, dtype=bool)
        self._last_time = 0.0

    def observe(self, runs: slice, time: float, pose: FloatArray, output: ControlOutput) -> None:
        """Take the true poses of some of the runs, shape (B, 3), at a time [s]."""
        if round(time / self._period) % self._stride:
            return
        with np.errstate(all="ignore"):  # runs that are lost may be anywhere
            error = tracking_error(pose, output.target_pose)
            place = beside(self._path, pose, output.arc_length, _LONGEST_STEP)
        distance, angle = place.cross_track, place.heading
        self._unsettled[runs][~criteria.is_settled(error)] = time
        self._last_time = max(self._last_time, time)
        if time >= self._counted_from:
            self._squares[runs] += distance**2
            self._largest[runs] = np.maximum(self._largest[runs], np.abs(distance))
            self._count += runs.start == 0
        if time >= self._end_from:
            near = np.abs(angle) <= 0.5 * math.pi
            self._ends_on_path[runs] &= near & ~criteria.is_off_path(distance)

    def result(self) -> Tracking:
        """Return what was seen."""
        settling = self._unsettled + self._stride * self._period
        never = self._unsettled >= self._last_time
        return Tracking(
            cross_track_rms=np.sqrt(self._squares / max(1, self._count)),
            cross_track_max=self._largest,
            settling_time=np.where(never, math.inf, np.maximum(settling, 0.0)),
            ends_on_path=self._ends_on_path,
        )
