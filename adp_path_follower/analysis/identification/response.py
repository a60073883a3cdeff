"""How encoders answer commands: delay, lags and ramp, fitted jointly.

Each model filters the commands by the firmware's ramp and the wheels' lags, and is compared with
the encoders' velocities at their stamps.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from adp_path_follower.analysis.identification.estimate import Estimate, estimate
from adp_path_follower.analysis.identification.recording import Recording
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.model import RobotModel

_CELL = 0.005  # [s] between two values of a filtered command
_DELAYS = np.arange(0.0, 0.61, 0.03)  # [s]
_LAGS = (0.0, 0.05, 0.12, 0.25, 0.5)  # [s]
_SLOWNESS = (0.0, 0.08, 0.3, 0.8, 1.6)  # of the ramp [s^2/m]
_HIGHEST = np.array([1.0, 1.0, 1.0, 3.0])  # of delay, lags and slowness
_STEPS = np.array([0.01, 0.01, 0.01, 0.03])  # over which the errors' slopes are taken
_UNKNOWN = np.array([0.3, 0.3, 0.3, 1.0])  # standard deviations of what no drive has told
_MOVING = 0.05  # [m/s, rad/s]
_RUN_IN = 2.0  # [s] after which it does not matter how a drive began
_OUTLIER = 5.0  # standard deviations
_LEAST = np.array([5e-4, 1e-3])  # [m/s, rad/s] of noise, so that a simulated robot has some
_SAMPLING = 0.015  # [s] between two looks of others at a command or a wheel
_BLOCK = 1.0  # [s] whose errors hang together


@dataclass(frozen=True)
class Fit:
    """The fitted response, with the encoders' noise."""

    values: Estimate  # delay, linear lag, angular lag [s], slowness of the ramp [s^2/m]
    noise: FloatArray  # standard deviations of the encoders' v and w, shape (2,)
    explained: FloatArray  # share of the motion of v and of w that the model explains, shape (2,)


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
        self._ramps: dict[float, FloatArray] = {0.0: self._mean[0]}
        begun = np.abs(recording.encoders[0]).max() > _MOVING
        self.used = recording.time >= recording.time[0] + _RUN_IN * begun

    def answered(self, part: int, lag: float, slowness: float = 0.0) -> FloatArray:
        """Return v or w of wheels without delay at the edges of the cells, shape (G + 1,)."""
        wanted = self._ramped(slowness) if part == 0 else self._mean[1]
        fade = math.exp(-_CELL / lag) if lag > 1e-6 else 0.0
        return np.append(wanted[0], lfilter([1.0 - fade], [1.0, -fade], wanted))

    def at(self, answered: FloatArray, delay: float) -> FloatArray:
        """Return it at the stamps of the encoders, after a delay [s], shape (N,)."""
        return np.interp(self._recording.time - delay, self._edges, answered)

    def model(self, values: FloatArray) -> FloatArray:
        """Return v, w at the stamps by delay, lags and slowness, shape (N, 2)."""
        delay, lag_v, lag_w, slowness = values.tolist()
        answers = self.answered(0, lag_v, slowness), self.answered(1, lag_w)
        return np.column_stack([self.at(answer, delay) for answer in answers])

    def _ramped(self, slowness: float) -> FloatArray:
        if slowness < 1e-3:
            return self._mean[0]
        if slowness not in self._ramps:
            most, now, found = _CELL / slowness, 0.0, []
            for wanted in self._mean[0].tolist():
                now += min(max(wanted - now, -most), most)
                found.append(now)
            self._ramps = {slowness: np.array(found)}
        return self._ramps[slowness]


def modelled(recording: Recording, model: RobotModel) -> FloatArray:
    """Return the encoders' v, w that a model expects of a recording, shape (N, 2)."""
    lags = model.linear_lag, model.angular_lag
    return _Filter(recording).model(np.array([model.delay, *lags, 1.0 / model.ramp]))


def fit_response(recordings: Sequence[Recording]) -> Fit:
    """Return the response that explains the encoders of all recordings best."""
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

    start, scale = _start(filters, recordings)
    found = _refined(scaled, start)
    wrong = np.abs(errors(found)) > _OUTLIER * np.maximum(scale, _LEAST)
    used &= ~wrong.any(axis=1)
    found = _refined(scaled, found)
    error = errors(found)
    scale = np.maximum(np.std(error[used], axis=0), _LEAST)
    values = estimate(
        found, scaled(found), _slopes(scaled, found), np.repeat(block[used], 2), _UNKNOWN
    )
    noise = np.sqrt(0.5 * np.mean(np.diff(error[used], axis=0) ** 2, axis=0))
    spread = np.mean(measured[used] ** 2, axis=0)
    missed = np.mean(error[used] ** 2, axis=0)
    explained = 1.0 - missed / np.maximum(spread, 1e-12)
    # Firmware and recorder sample, too.
    unsure = np.array([1.0, 1.0, 1.0, 0.0]) * _SAMPLING / math.sqrt(12.0)
    deviations = np.hypot(values.deviations, unsure)
    return Fit(Estimate(values.values, deviations, values.factor), noise, explained)


def _refined(errors: Callable[[FloatArray], FloatArray], start: FloatArray) -> FloatArray:
    """Return the values within their bounds that have the least errors."""
    bounds = np.zeros(4), _HIGHEST
    found = least_squares(
        errors, start, lambda values: _slopes(errors, values), bounds=bounds, x_scale=_STEPS
    )
    return np.asarray(found.x)


def _slopes(errors: Callable[[FloatArray], FloatArray], values: FloatArray) -> FloatArray:
    """Return the changes of errors (N,) with the values, shape (N, 4)."""
    found = []
    for step in np.diag(_STEPS):
        low, high = np.maximum(values - step, 0.0), values + step
        found.append((errors(high) - errors(low)) / (high - low).sum())
    return np.column_stack(found)


def _start(
    filters: Sequence[_Filter], recordings: Sequence[Recording]
) -> tuple[FloatArray, FloatArray]:
    """Return the best of a grid of models, and the errors' deviations there, shape (2,)."""

    def missed(part: int, lag: float, slowness: float) -> FloatArray:
        """Return the mean squared error at each delay."""
        sums, count = np.zeros(len(_DELAYS)), 0
        for item, recording in zip(filters, recordings, strict=True):
            answered = item.answered(part, lag, slowness)
            truth = recording.encoders[item.used, part]
            sums += [
                np.sum((item.at(answered, delay)[item.used] - truth) ** 2) for delay in _DELAYS
            ]
            count += len(truth)
        return sums / max(count, 1)

    linear = np.array([[missed(0, lag, slow) for lag in _LAGS] for slow in _SLOWNESS])
    angular = np.array([missed(1, lag, 0.0) for lag in _LAGS])
    scale = np.maximum(np.sqrt([linear.min(), angular.min()]), _LEAST)
    joint = linear.min(axis=(0, 1)) / scale[0] ** 2 + angular.min(axis=0) / scale[1] ** 2
    place = int(joint.argmin())
    slow, lag = np.unravel_index(int(linear[:, :, place].argmin()), linear.shape[:2])
    lags = _LAGS[int(lag)], _LAGS[int(angular[:, place].argmin())]
    return np.array([_DELAYS[place], *lags, _SLOWNESS[int(slow)]]), scale
