"""The state of a robot from late and noisy odometry, its gains and its bias: Kalman filters.

The state of each is [x, y, theta, v, w, k_v, k_w, b] with the model's symbols. Between two messages
it moves as the model does with the commands that acted meanwhile; a message corrects it by the
localised pose and by the encoders' twist. Their noise is found from what remains after the
correction.
"""

import math
from dataclasses import replace

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.history import CommandHistory
from adp_path_follower.core.robot.model import RobotModel, RobotState, advanced

_SHORTEST = 1e-4  # [s] between two messages; less is the rounding of one stamp
_LONGEST = 1.0  # [s] between two messages of one robot that was observed all the time
_POSE, _TWIST, _GAINS = slice(0, 3), slice(3, 5), slice(5, 8)
# Variances per second of what the model does not know: slip, uneven floor, torque.
_DISTURBANCE = np.array([0.002, 0.002, 0.003, 0.015, 0.03, 2e-4, 4e-4, 4e-4]) ** 2
# Shares of these variances in the filters of the bank, from the distrustful to the trustful one.
_TRUSTS = np.array([1.0, 0.1, 0.01])[:, None, None]
_COUNT = len(_TRUSTS)
_MEMORY = 8.0  # [s] of messages in the evidence
_LOST, _ANEW = -7.0, -2.0  # logarithms of a weight at which a filter begins anew, and with which
_UNSURE = 0.3  # share of a change of velocity that the model may miss
_TURNED = 1.0  # [1/m] turn rate that comes with a change of velocity, as wheels differ
_START = np.array([0.02, 0.02, 0.03, 0.05, 0.05]) ** 2
# Wheels larger than the odometry believes move and turn the robot farther alike: k_v and k_w start
# with a common part, to which k_w adds that of the track.
_SIZE, _TRACK, _BIAS = 0.03**2, 0.03**2, 0.03**2
_GAINS_START = np.array([[_SIZE, _SIZE, 0.0], [_SIZE, _SIZE + _TRACK, 0.0], [0.0, 0.0, _BIAS]])
_LEAST_GAINS, _MOST_GAINS = np.array([0.88, 0.8, -0.15]), np.array([1.12, 1.25, 0.15])
_FLOOR = np.array([1e-4, 1e-4, 2e-4, 2e-3, 4e-3]) ** 2  # of the noise of a message
_NOISE = np.array([0.005, 0.005, 0.01, 0.01, 0.02]) ** 2  # at the start
_MOST_NOISE = np.array([0.05, 0.1]) ** 2  # of v and w
_LITTLE_NOISE = np.array([0.003, 0.003, 0.006]) ** 2  # of the pose
_SURE, _SMALL = 4.0, 1e-3  # standard deviations, and gain or bias, that are not chance
_ADAPTATION = 0.04  # share of one message in the noise, ...
_EARLY = 0.2  # of the first one
_JUMP = 9.0  # squared distance of a wheel's velocity that the model has missed
_GATE = 40.0  # squared distance of a pose, in standard deviations, that is an outlier
_OUTLIERS = 5  # in a row, after which it is believed


class StateEstimator:
    """Knows state, gains and bias at the stamp of the last odometry.

    It is a bank of filters that trust the model to different degrees. Each is weighed by how well
    it foretold the latest messages, and the weighted mean is the estimate.
    """

    def __init__(self, model: RobotModel, learns: bool) -> None:
        """Begin with the gains of a model, which stay if it does not learn."""
        self.stamp: float | None = None  # of the last message [s]
        self.frozen = False  # gains and bias
        self.unanswered = False  # whether the robot rests while it is told to move: no noise
        self._learns = learns
        self.noise: FloatArray = _NOISE.copy()  # variances of x, y, theta, v, w in a message
        self._means = np.zeros((_COUNT, 8))
        self._start_gains = np.array([model.linear_gain, model.angular_gain, model.bias])
        self._means[:, _GAINS] = self._start_gains
        self._covariances = np.zeros((_COUNT, 8, 8))
        if learns:
            self._covariances[:, _GAINS, _GAINS] = _GAINS_START
        self._evidence = np.zeros(_COUNT)  # logarithms of the weights
        self._outliers, self._share = 0, _EARLY
        self._left: FloatArray = np.zeros((_COUNT, 5))  # of the last surprises
        self._mix()
        # The effect of a change of v or w halfway between two messages until the second.
        self._pushes = np.zeros((8, 2))
        self._pushes[3, 0] = self._pushes[4, 1] = 1.0

    def _mix(self) -> None:
        """Weigh the filters, and set those that are out of the question on the weighted mean."""
        self._evidence -= self._evidence.max()
        self._weights: FloatArray = np.exp(self._evidence)
        self._weights /= self._weights.sum()
        self._mean: FloatArray = self._weights @ self._means
        lost = self._evidence < _LOST
        if lost.any():
            self._evidence[lost] = _ANEW
            together = np.tensordot(self._weights, self._covariances, 1)
            self._means[lost], self._covariances[lost] = self._mean, together

    @property
    def state(self) -> RobotState:
        """Return the state at the stamp."""
        return RobotState(*self._mean[:5].tolist())

    def with_gains(self, model: RobotModel) -> RobotModel:
        """Return a model with the present gains and bias."""
        bounded = np.minimum(np.maximum(self._mean[_GAINS], _LEAST_GAINS), _MOST_GAINS)
        gain, turn_gain, bias = bounded.tolist()
        return replace(model, linear_gain=gain, angular_gain=turn_gain, bias=bias)

    @property
    def deviations(self) -> FloatArray:
        """Return the standard deviations of k_v, k_w and b, shape (3,)."""
        variances = self._covariances[:, range(5, 8), range(5, 8)]
        return np.asarray(np.sqrt(self._weights.dot(variances)))

    @property
    def tells_more(self) -> bool:
        """Return whether odometry needs a filter, or gains or bias are not those of the start."""
        if self._share > _ADAPTATION:
            return False
        unlike = np.abs(self._mean[_GAINS] - self._start_gains)
        found = unlike > _SURE * self.deviations + _SMALL
        return bool(found.any() or (self.noise[_POSE] > _LITTLE_NOISE).any())

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
        if elapsed < _SHORTEST:
            return False
        measured = np.array([*pose, *twist])
        if elapsed >= _LONGEST:
            self._start(stamp, measured)
            return True
        assert self.stamp is not None  # else it has just started
        late = self.stamp - model.delay
        self._predict(self.with_gains(model), history.held(late, late + elapsed), elapsed)
        self.stamp = stamp
        self._correct(measured, elapsed)
        self._mix()
        return True

    def _start(self, stamp: float, measured: FloatArray) -> None:
        self.stamp, self._outliers = stamp, 0
        self._means[:, :5] = measured
        self._covariances[:, :5, :] = self._covariances[:, :, :5] = 0.0
        self._covariances[:, range(5), range(5)] = np.maximum(_START, self.noise)
        self._mix()

    def _predict(
        self, model: RobotModel, commands: list[tuple[float, float, float]], elapsed: float
    ) -> None:
        """Move on by an elapsed time [s], and with it the covariances.

        The filters are near to each other: one slope does for all.
        """
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
        forwards = gain * by_distance + bias * by_turn
        slopes[_POSE, 2] += (-dy, dx, 0.0)
        slopes[_POSE, 3] = v_reach * forwards
        slopes[_POSE, 4] = w_reach * turn_gain * by_turn
        slopes[_POSE, 5] = driven * by_distance
        slopes[_POSE, 6] = turned * by_turn
        slopes[_POSE, 7] = driven * by_turn
        slopes[3, 3], slopes[4, 4] = v_left, w_left
        self._pushes[_POSE, 0] = 0.5 * elapsed * forwards
        self._pushes[_POSE, 1] = 0.5 * elapsed * turn_gain * by_turn
        faster, turning = after.v - before.v, after.w - before.w
        missed = (_UNSURE * faster) ** 2, (_UNSURE * turning) ** 2 + (_TURNED * faster) ** 2
        spread = (self._pushes * missed) @ self._pushes.T
        spread[range(5), range(5)] += _DISTURBANCE[:5] * elapsed
        self._covariances = slopes @ self._covariances @ slopes.T + _TRUSTS * spread
        if self._learns and not self.frozen:
            self._covariances[:, range(5, 8), range(5, 8)] += _DISTURBANCE[_GAINS] * elapsed
        moved = np.array([after.x, after.y, after.theta, after.v, after.w, *self._mean[_GAINS]])
        self._means = moved + (self._means - self._mean) @ slopes.T

    def _correct(self, measured: FloatArray, elapsed: float) -> None:
        """Correct the state by a message, and learn its noise from what remains."""
        surprise = measured - self._means[:, :5]
        surprise[:, 2] = np.remainder(surprise[:, 2] + math.pi, math.tau) - math.pi
        # Wheels that are not where the model has them have been accelerated otherwise.
        unlike = surprise[:, _TWIST] ** 2
        likely = self._covariances[:, (3, 4), (3, 4)] + self.noise[_TWIST]
        jumps = np.where(unlike > _JUMP * likely, unlike, 0.0)
        jumped = bool(jumps.any())
        if jumped:
            self._covariances += (self._pushes * jumps[:, None]) @ self._pushes.T
        seen = self._covariances[:, :5, :]
        expected = seen[:, :, :5] + np.diag(self.noise)
        far = surprise[:, _POSE] ** 2 / expected[:, range(3), range(3)]
        outlier = bool(far.sum(axis=1).min() > _GATE)
        self._outliers = self._outliers + 1 if outlier else 0
        if self._outliers > _OUTLIERS:
            self._start(self.stamp or 0.0, measured)
            return
        if outlier:
            return
        inverse = np.linalg.inv(expected)
        if self._share <= _ADAPTATION and not self.unanswered:  # the noise is known
            distance = (surprise[:, None, :] @ inverse @ surprise[:, :, None])[:, 0, 0]
            distance += np.log(np.linalg.det(expected)) + _JUMP * (jumps > 0.0).sum(axis=1)
            self._evidence -= 0.5 * distance + elapsed / _MEMORY * self._evidence
        gain = seen.swapaxes(1, 2) @ inverse
        if self.frozen or not self._learns:
            gain[:, _GAINS] = 0.0
        elif jumped:
            gain[jumps.any(axis=1), _GAINS] = 0.0
        correction = (gain @ surprise[:, :, None])[:, :, 0]
        self._means += correction
        self._means[:, _GAINS] = np.minimum(
            np.maximum(self._means[:, _GAINS], _LEAST_GAINS), _MOST_GAINS
        )
        keeps = np.tile(np.eye(8), (_COUNT, 1, 1))
        keeps[:, :, :5] -= gain  # Joseph's form, which no rounding makes negative
        self._covariances = keeps @ self._covariances @ keeps.swapaxes(1, 2)
        self._covariances += (gain * self.noise) @ gain.swapaxes(1, 2)
        if not self.unanswered:
            self._learn_noise(surprise - correction[:, :5], jumps)

    def _learn_noise(self, left: FloatArray, jumps: FloatArray) -> None:
        """Learn the noise of a message from what is left of surprises (N, 5) after correction.

        Noise has no memory: what is left alike of two messages is a fault of the state.
        """
        found = self._weights @ (
            left * (left - self._left) + self._covariances[:, range(5), range(5)]
        )
        self._left = left
        found[3:] = np.minimum(found[3:], _MOST_NOISE)
        found[3:] = np.where(jumps.any(axis=0), self.noise[3:], found[3:])
        found[:2] = 0.5 * (found[0] + found[1])
        self._share = max(_ADAPTATION, self._share / (1.0 + self._share))
        self.noise = np.maximum(self.noise + self._share * (found - self.noise), _FLOOR)


def _faded(elapsed: float, lag: float) -> tuple[float, float]:
    """Return which share of a velocity is left after a time [s], and the time it was worth."""
    if lag <= 0.0:
        return 0.0, 0.0
    left = math.exp(-elapsed / lag)
    return left, lag * (1.0 - left)
