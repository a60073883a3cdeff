"""How encoders answer commands: delay, lags and ramps, fitted jointly.

Each model filters the commands by the firmware's ramps and the wheels' lags, and is compared with
the encoders' velocities at their stamps.
"""

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import lfilter

from adp_path_follower.analysis.identification.estimate import Estimate, estimate
from adp_path_follower.analysis.identification.recording import Recording
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.model import RobotModel

_CELL = 0.005  # [s] between two values of a filtered command
_DELAYS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.55)  # [s]
_LAGS = (0.0, 0.06, 0.15, 0.35)  # [s]
_SLOWNESS = (0.0, 0.08, 0.4, 1.2), (0.0, 0.03, 0.1, 0.3)  # of the ramps [s^2/m, s^2/rad]
_HIGHEST = np.array([1.0, 1.0, 1.0, 3.0, 1.0])  # of delay, lags and slownesses
_STEPS = np.array([0.01, 0.01, 0.01, 0.03, 0.01])  # over which the errors' slopes are taken
_UNKNOWN = np.array([0.3, 0.3, 0.3, 1.0, 0.5])  # standard deviations of what no drive has told
_MOVING = 0.05  # [m/s, rad/s]
_RUN_IN = 2.0  # [s] after which it does not matter how a drive began
_OUTLIER = 5.0  # standard deviations
_LEAST = np.array([5e-4, 1e-3])  # [m/s, rad/s] of noise, so that a simulated robot has some
_SAMPLING = 0.008  # [s] by which all times may be wrong, as firmware and recorder sample, too
_PERIODS = 2.0  # of the odometry that a ramp lasts which is told
_BLOCK = 1.0  # [s] whose errors hang together


class _Filter:
    """The commands of one recording in cells of equal length, and models of the encoders."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        first = min(recording.sent[0], recording.time[0])
        last = max(recording.sent[-1], recording.time[-1])
        self._edges = first + _CELL * np.arange(math.ceil((last - first) / _CELL) + 2)
        held = np.diff(recording.sent, append=self._edges[-1])
        sums = np.vstack([np.zeros(2), np.cumsum(held[:, None] * recording.commands, axis=0)])
        times = np.append(recording.sent, max(self._edges[-1], recording.sent[-1]))
        so_far = [np.interp(self._edges, times, column) for column in sums.T]
        self._mean = np.diff(so_far, axis=1) / _CELL  # of v and w in each cell, (2, G)
        self._ramped_last = [(0.0, mean) for mean in self._mean]  # by which slowness
        begun = np.abs(recording.encoders[0]).max() > _MOVING
        self.used = recording.time >= recording.time[0] + _RUN_IN * begun

    def answered(self, part: int, lag: float, slowness: float) -> FloatArray:
        """Return v or w of wheels without delay at the edges of the cells, shape (G + 1,)."""
        wanted = self._ramped(part, slowness)
        fade = math.exp(-_CELL / lag) if lag > 1e-6 else 0.0
        return np.append(0.0, lfilter([1.0 - fade], [1.0, -fade], wanted))

    def at(self, answered: FloatArray, delay: float) -> FloatArray:
        """Return it at the stamps of the encoders, after a delay [s], shape (N,)."""
        return np.interp(self._recording.time - delay, self._edges, answered)

    def model(self, values: FloatArray) -> FloatArray:
        """Return v, w at the stamps by delay, lags and slownesses, shape (N, 2)."""
        delay, lag_v, lag_w, slow_v, slow_w = values.tolist()
        answers = self.answered(0, lag_v, slow_v), self.answered(1, lag_w, slow_w)
        return np.column_stack([self.at(answer, delay) for answer in answers])

    def ramps_last(self, values: FloatArray) -> float:
        """Return how long the slower ramp is at work for the largest change [odometry periods]."""
        period = float(np.median(np.diff(self._recording.time)))
        behind = (
            np.abs(self._mean[part] - self._ramped(part, values[3 + part])) for part in (0, 1)
        )
        times = [slow * away.max() for slow, away in zip(values[3:], behind, strict=True)]
        return float(max(times)) / period

    def _ramped(self, part: int, slowness: float) -> FloatArray:
        if slowness < 1e-3:
            return np.asarray(self._mean[part])
        if slowness != self._ramped_last[part][0]:
            most, now, found = _CELL / slowness, 0.0, []
            for wanted in self._mean[part].tolist():
                now += min(max(wanted - now, -most), most)
                found.append(now)
            self._ramped_last[part] = slowness, np.array(found)
        return self._ramped_last[part][1]


def modelled(recording: Recording, model: RobotModel) -> FloatArray:
    """Return the encoders' v, w that a model expects of a recording, shape (N, 2)."""
    slowness = (1.0 / ramp for ramp in model.ramps)
    values = np.array([model.delay, model.linear_lag, model.angular_lag, *slowness])
    return _Filter(recording).model(values)


def fit_response(recordings: Sequence[Recording]) -> tuple[Estimate, FloatArray, FloatArray]:
    """Return the response that explains the encoders of all recordings best.

    It is delay, linear lag, angular lag [s] and slownesses of the ramps [s^2/m, s^2/rad]; then come
    the standard deviations of the encoders' v and w, and the shares of their motion that the model
    explains, shape (2,) each.
    """
    filters = [_Filter(recording) for recording in recordings]
    measured = np.concatenate([item.encoders for item in recordings])
    used = np.concatenate([item.used for item in filters])
    # Blocks count on from one recording to the next.
    blocks, count = [], 0
    for item in recordings:
        numbers = ((item.time - item.time[0]) / _BLOCK).astype(int)
        blocks.append(count + numbers)
        count += int(numbers[-1]) + 1
    block = np.concatenate(blocks)

    def errors(values: FloatArray) -> FloatArray:
        return np.concatenate([item.model(values) for item in filters]) - measured

    def scaled(values: FloatArray) -> FloatArray:
        return np.asarray((errors(values)[used] / scale).ravel())

    scale = np.maximum(np.std(measured, axis=0), _LEAST)
    fits = {
        free: _refined(scaled, _start(filters, measured, used, scale, slownesses), free)
        for free, slownesses in ((3, ((0.0,), (0.0,))), (5, _SLOWNESS))
    }
    # Encoders tell the mean velocity of a period: a ramp that is over by then is none.
    lasts = max(item.ramps_last(fits[5]) for item in filters)
    better = np.sum(scaled(fits[5]) ** 2) < np.sum(scaled(fits[3]) ** 2)
    free = 5 if lasts > _PERIODS and better else 3  # numbers to fit, with ramps or without
    found = fits[free]
    for _ in range(2):  # the second time without outliers, and with the scale of the errors
        found = _refined(scaled, found, free)
        scale = np.maximum(np.std(errors(found)[used], axis=0), _LEAST)
        used &= (np.abs(errors(found)) < _OUTLIER * scale).all(axis=1)
    error = errors(found)
    values = estimate(
        found, scaled(found), _slopes(scaled, found), np.repeat(block[used], 2), _UNKNOWN
    )
    noise = np.sqrt(0.5 * np.mean(np.diff(error[used], axis=0) ** 2, axis=0))
    spread = np.maximum(np.mean(measured[used] ** 2, axis=0), 1e-12)
    explained = 1.0 - np.mean(error[used] ** 2, axis=0) / spread
    room = np.hypot(values.room, np.array([1.0, 1.0, 1.0, 0.0, 0.0]) * _SAMPLING)
    return Estimate(found, room), noise, explained


def _start(
    filters: Sequence[_Filter],
    measured: FloatArray,
    used: NDArray[np.bool_],
    scale: FloatArray,
    slowest: tuple[tuple[float, ...], ...],
) -> FloatArray:
    """Return the values of a coarse grid that explain velocities (N, 2) best."""
    misfits: dict[tuple[float, int], list[tuple[float, float, float]]] = {}
    for part, slownesses in enumerate(slowest):
        for slow, lag in itertools.product(slownesses, _LAGS):
            answers = [item.answered(part, lag, slow) for item in filters]
            for delay in _DELAYS:
                pairs = zip(filters, answers, strict=True)
                expected = np.concatenate([item.at(answer, delay) for item, answer in pairs])
                error = (expected - measured[:, part])[used] / scale[part]
                misfits.setdefault((delay, part), []).append((float(error @ error), lag, slow))
    best = {delay: [min(misfits[delay, part]) for part in (0, 1)] for delay in _DELAYS}
    delay = min(best, key=lambda delay: best[delay][0][0] + best[delay][1][0])
    (_, lag_v, slow_v), (_, lag_w, slow_w) = best[delay]
    return np.array([delay, lag_v, lag_w, slow_v, slow_w])


def _refined(
    errors: Callable[[FloatArray], FloatArray], start: FloatArray, free: int
) -> FloatArray:
    """Return values within their bounds of which the first ones are free, with least errors."""
    fixed = start[free:]
    found = least_squares(
        lambda values: errors(np.append(values, fixed)),
        start[:free],
        lambda values: _slopes(errors, np.append(values, fixed))[:, :free],
        bounds=(np.zeros(free), _HIGHEST[:free]),
        x_scale=_STEPS[:free],
    )
    return np.append(found.x, fixed)


def _slopes(errors: Callable[[FloatArray], FloatArray], values: FloatArray) -> FloatArray:
    """Return the changes of errors (N,) with the values, shape (N, 5)."""
    found = []
    for step in np.diag(_STEPS):
        low, high = np.maximum(values - step, 0.0), values + step
        found.append((errors(high) - errors(low)) / (high - low).sum())
    return np.column_stack(found)
