"""The state of a robot from late and noisy odometry, and its gains and bias: one Kalman filter.

The state is [x, y, theta, v, w, k_v, k_w, b] with the model's symbols. Between two messages it
moves as the model does with the commands that acted meanwhile; a message corrects it by the
localised pose and by the encoders' twist. Their noise is found from what remains after the
correction.
"""

import math
from dataclasses import replace

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.history import CommandHistory
from adp_path_follower.core.robot.model import RobotModel, RobotState, advanced

_LONGEST = 1.0  # [s] between two messages of one robot that was observed all the time
_POSE, _TWIST, _GAINS = slice(0, 3), slice(3, 5), slice(5, 8)
# Variances per second of what the model does not know: slip, uneven floor, torque.
_DISTURBANCE = np.array([0.002, 0.002, 0.003, 0.015, 0.03, 2e-4, 4e-4, 4e-4]) ** 2
_UNSURE = 0.3  # share of a change of velocity that the model may miss
_TURNED = 1.0  # [1/m] turn rate that comes with a change of velocity, as wheels differ
_START = np.array([0.02, 0.02, 0.03, 0.05, 0.05]) ** 2
_GAINS_START = np.array([0.03, 0.04, 0.03]) ** 2
_LEAST_GAINS, _MOST_GAINS = np.array([0.88, 0.8, -0.15]), np.array([1.12, 1.25, 0.15])
_FLOOR = np.array([1e-4, 1e-4, 2e-4, 2e-3, 4e-3]) ** 2  # of the noise of a message
_NOISE = np.array([0.005, 0.005, 0.01, 0.01, 0.02]) ** 2  # at the start
_MOST_NOISE = np.array([0.05, 0.1]) ** 2  # of v and w
_ADAPTATION = 0.04  # share of one message in the noise
_JUMP = 9.0  # squared distance of a wheel's velocity that the model has missed
_GATE = 40.0  # squared distance of a pose, in standard deviations, that is an outlier
_OUTLIERS = 5  # in a row, after which it is believed


class StateEstimator:
    """Knows state, gains and bias at the stamp of the last odometry."""

    def __init__(self, model: RobotModel, learns: bool) -> None:
        """Begin with the gains of a model, which stay if it does not learn."""
        self.stamp: float | None = None  # of the last message [s]
        self.frozen = False  # gains and bias
        self.noise: FloatArray = _NOISE.copy()  # variances of x, y, theta, v, w in a message
        self._learns = learns
        self._found = self.noise.copy()
        self._mean = np.zeros(8)
        self._mean[_GAINS] = model.linear_gain, model.angular_gain, model.bias
        self._covariance = np.zeros((8, 8))
        if learns:
            self._covariance[_GAINS, _GAINS] = np.diag(_GAINS_START)
        self._outliers = 0
        # The effect of a change of v or w halfway between two messages until the second.
        self._pushes = np.zeros((8, 2))
        self._pushes[3, 0] = self._pushes[4, 1] = 1.0

    @property
    def state(self) -> RobotState:
        """Return the state at the stamp."""
        return RobotState(*self._mean[:5].tolist())

    def with_gains(self, model: RobotModel) -> RobotModel:
        """Return a model with the present gains and bias."""
        gain, turn_gain, bias = self._mean[_GAINS].tolist()
        return replace(model, linear_gain=gain, angular_gain=turn_gain, bias=bias)

    @property
    def deviations(self) -> FloatArray:
        """Return the standard deviations of k_v, k_w and b, shape (3,)."""
        return np.sqrt(np.diag(self._covariance)[_GAINS])

    def forget_state(self) -> None:
        """Begin anew with the next message: the robot was not observed; gains stay."""
        self.stamp = None

    def observe(
        self,
        stamp: float,
        pose: tuple[float, float, float],
        twist: tuple[float, float],
        model: RobotModel,
        history: CommandHistory,
    ) -> bool:
        """Take in a message; return whether it is newer than the last one.

        It has a time [s], x [m], y [m], theta [rad], and v [m/s], w [rad/s] of the encoders. The
        model gives delay, lags and ramp, the history the commands that were sent until then.
        """
        elapsed = _LONGEST if self.stamp is None else stamp - self.stamp
        if elapsed <= 0.0:
            return False
        measured = np.array([*pose, *twist])
        if elapsed >= _LONGEST:
            self._start(stamp, measured)
            return True
        assert self.stamp is not None  # else it has just started
        late = self.stamp - model.delay
        self._predict(self.with_gains(model), history.held(late, late + elapsed), elapsed)
        self.stamp = stamp
        self._correct(measured)
        return True

    def _start(self, stamp: float, measured: FloatArray) -> None:
        self.stamp, self._outliers = stamp, 0
        self._mean[:5] = measured
        self._covariance[:5, :] = self._covariance[:, :5] = 0.0
        self._covariance[range(5), range(5)] = np.maximum(_START, self.noise)

    def _predict(
        self, model: RobotModel, commands: list[tuple[float, float, float]], elapsed: float
    ) -> None:
        """Move on by an elapsed time [s], and with it the covariance."""
        before = self.state
        after = advanced(model, before, commands)
        slopes = np.eye(8)
        gain, turn_gain, bias = model.linear_gain, model.angular_gain, model.bias
        v_left, v_reach = _faded(elapsed, model.linear_lag)
        w_left, w_reach = _faded(elapsed, model.angular_lag)
        dx, dy, turn = after.x - before.x, after.y - before.y, after.theta - before.theta
        middle = before.theta + 0.5 * turn
        along = math.cos(middle), math.sin(middle)
        driven = (dx * along[0] + dy * along[1]) / gain
        turned = (turn - bias * driven) / turn_gain
        by_turn = np.array([-0.5 * dy, 0.5 * dx, 1.0])
        by_distance = np.array([*along, 0.0])
        slopes[_POSE, 2] += (-dy, dx, 0.0)
        slopes[_POSE, 3] = v_reach * (gain * by_distance + bias * by_turn)
        slopes[_POSE, 4] = w_reach * turn_gain * by_turn
        slopes[_POSE, 5] = driven * by_distance
        slopes[_POSE, 6] = turned * by_turn
        slopes[_POSE, 7] = driven * by_turn
        slopes[3, 3], slopes[4, 4] = v_left, w_left
        spread = _DISTURBANCE * elapsed
        faster, turning = after.v - before.v, after.w - before.w
        self._pushes[_POSE, 0] = 0.5 * elapsed * (gain * by_distance + bias * by_turn)
        self._pushes[_POSE, 1] = 0.5 * elapsed * turn_gain * by_turn
        missed = (_UNSURE * faster) ** 2, (_UNSURE * turning) ** 2 + (_TURNED * faster) ** 2
        if self.frozen or not self._learns:
            spread[_GAINS] = 0.0
        self._covariance = slopes @ self._covariance @ slopes.T
        self._covariance += (self._pushes * missed) @ self._pushes.T
        self._covariance[range(8), range(8)] += spread
        self._mean[:5] = after.x, after.y, after.theta, after.v, after.w

    def _correct(self, measured: FloatArray) -> None:
        """Correct the state by a message, and learn its noise from what remains."""
        surprise = measured - self._mean[:5]
        surprise[2] = math.remainder(surprise[2], math.tau)
        # Wheels that are not where the model has them have been accelerated otherwise.
        unlike = surprise[_TWIST] ** 2
        likely = self._covariance[(3, 4), (3, 4)] + self.noise[_TWIST]
        jumps = np.where(unlike > _JUMP * likely, unlike, 0.0)
        if jumps.any():
            self._covariance += (self._pushes * jumps) @ self._pushes.T
        expected = self._covariance[:5, :5] + np.diag(self.noise)
        gain = np.linalg.solve(expected, self._covariance[:5, :]).T
        pose = surprise[_POSE]
        distance = float(pose @ np.linalg.solve(expected[_POSE, _POSE], pose))
        outlier = distance > _GATE
        self._outliers = self._outliers + 1 if outlier else 0
        if self._outliers > _OUTLIERS:
            self._start(self.stamp or 0.0, measured)
            return
        if outlier:
            return
        if self.frozen or not self._learns or jumps.any():
            gain[_GAINS] = 0.0
        self._mean += gain @ surprise
        self._mean[_GAINS] = np.clip(self._mean[_GAINS], _LEAST_GAINS, _MOST_GAINS)
        keeps = np.eye(8)
        keeps[:, :5] -= gain
        self._covariance = keeps @ self._covariance @ keeps.T + (gain * self.noise) @ gain.T
        # The deviation of a message, less that of the state.
        found = surprise * surprise - (expected.diagonal() - self.noise)
        found[3:] = np.where(jumps > 0.0, self.noise[3:], np.minimum(found[3:], _MOST_NOISE))
        found[:2] = 0.5 * (found[0] + found[1])
        self._found += _ADAPTATION * (found - self._found)
        self.noise = self._found = np.maximum(self._found, _FLOOR)


def _faded(elapsed: float, lag: float) -> tuple[float, float]:
    """Return which share of a velocity is left after a time [s], and the time it was worth."""
    if lag <= 0.0:
        return 0.0, 0.0
    left = math.exp(-elapsed / lag)
    return left, lag * (1.0 - left)
