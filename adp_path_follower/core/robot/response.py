"""Delay, lags and ramps from how the encoders answer the commands: a bank of models.

Each member of the bank filters the commands with its own lag and ramp; the encoders' velocity is
compared with all of them, at each of several delays. The evidence weighs the members of the bank,
and their weighted mean is the model.
"""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.model import RobotModel

_DELAYS = np.arange(0.0, 0.42, 0.02)  # [s]
_LAGS = np.array([0.0, 0.025, 0.05, 0.08, 0.115, 0.155, 0.2, 0.25, 0.31, 0.38, 0.46])  # [s]
# One over a ramp of v [s^2/m]: the launch is most of the evidence, and lasts by this.
_SLOWNESS = np.array(
    [0, 0.12, 0.19, 0.25, 0.31, 0.37, 0.43, 0.5, 0.58, 0.66, 0.75, 0.86, 1, 1.2, 1.5, 2]
)
_ANGULAR_SLOWNESS = np.array([0, 0.03, 0.06, 0.1, 0.14, 0.19, 0.25, 0.33, 0.45])  # [s^2/rad]
_SLOW = (_SLOWNESS, _ANGULAR_SLOWNESS)
_LEVER, _LEVERS = 6.0, 0.4  # [1/m] of angular by linear ramps, usually, and how far robots differ
_NO_SLOWNESS = 1e-3  # [s^2/rad]
_DOUBT = (0.2, 3.0)  # logarithm of how much likelier no ramp is: every drive has a launch
_COUNTS = (len(_SLOWNESS), len(_ANGULAR_SLOWNESS))
with np.errstate(divide="ignore"):
    _RAMPS = 1.0 / np.concatenate(_SLOW)  # [m/s^2, rad/s^2], infinite for none
_FREE = np.isinf(_RAMPS)
_FINEST, _COARSEST = 0.004, 0.01  # [s] between two states of the members
_KEPT = 256  # states
_NOISE = np.array([0.012, 0.025])  # [m/s, rad/s] of encoders and model, at least
_SHORTEST = 1e-4  # [s] between two messages; less is the rounding of one stamp
_SPACING = 0.1  # [s] between messages that are independent
_TRANSIENT = 0.1  # [m/s] from the commanded velocity, ...
_CALM = 0.3  # [s] after which it is over
_MOVING = 0.05  # [m/s, rad/s]: slower ones tell nothing
_KEEPS = 0.98  # share of an agreement after one more message
_AGREE = -0.3  # share of the usual velocity, below which encoders and commands disagree
_LINEAR = len(_LAGS) * _COUNTS[0]  # members of the bank for v; those for w follow
_USUAL = (5, 4 * _COUNTS[0], _LINEAR + 4 * _COUNTS[1])  # delay and members of a usual robot
_ANSWER = 0.2  # share of the commanded motion, with which the robot has begun to answer, ...
_PATIENCE = 1.5  # [s] after which one that has not does not answer at all
_MEMORY = 40.0  # [s] of excited driving
_SIGNIFICANT = 8.0  # logarithm of how much likelier than the ideal robot a model must be
_TOGETHER = 0.08  # [s] by which the lags of v and w may well differ


@dataclass(frozen=True)
class Response:
    """Delay, lags and ramps, with standard deviations."""

    delay: float = 0.0  # [s]
    linear_lag: float = 0.0  # [s]
    angular_lag: float = 0.0  # [s]
    ramp: float = math.inf  # [m/s^2]
    angular_ramp: float = math.inf  # [rad/s^2]
    # Standard deviations of delay and lags [s].
    deviations: tuple[float, float, float] = (0.3, 0.3, 0.3)


class ResponseBank:
    """Compares the encoders with all models of the bank."""

    def __init__(self, start: RobotModel) -> None:
        """Begin with a robot at rest, no evidence, and what holds without any."""
        self._start = Response(start.delay, start.linear_lag, start.angular_lag, *start.ramps)
        self._lags = np.concatenate([np.repeat(_LAGS, count) for count in _COUNTS])
        linear, angular = np.split(np.arange(len(_RAMPS)), _COUNTS[:1])
        count = len(_LAGS)
        self._ramp_of = np.concatenate([np.tile(linear, count), np.tile(angular, count)])
        self._members = len(self._lags)
        self._agreement = np.full((2, 2), 0.3)
        self._evidence = np.zeros((len(_DELAYS), self._members))
        self.restart()

    def restart(self) -> None:
        """Begin with a robot at rest; evidence stays."""
        self._state = np.zeros(self._members)
        self._set = np.zeros(len(_RAMPS))  # velocities that the ramps let through
        self._times = np.zeros(2 * _KEPT)
        self._states = np.zeros((2 * _KEPT, self._members))
        self._stored = 0
        self._time: float | None = None
        self._stamp = self._transient = -math.inf
        self.unanswered = False  # whether the robot rests while it is told to move, ...
        self.held = False  # for so long that it is held
        self.hurried = False  # whether the wheels are, or just were, getting up to speed
        self._answer: tuple[float, FloatArray] | None = None  # the last, and the evidence then
        self._command = (0.0, 0.0)

    def advance(self, time: float, command: tuple[float, float]) -> None:
        """Let the members answer the last command until a time [s], when another one is sent."""
        if self._time is None:
            self._time, self._command = time, command
            self._store()
        elapsed, sent, self._command = time - self._time, self._command, command
        if elapsed <= 0.0:
            return
        pieces = max(1, math.ceil(elapsed / _COARSEST - 1e-6)) if elapsed < 1.0 else 1
        step = elapsed / pieces
        fade = np.exp(-step / np.maximum(self._lags, 1e-9))
        asked, most = np.repeat(sent, _COUNTS), _RAMPS * step
        for piece in range(pieces):
            before = self._set
            self._set = np.minimum(np.maximum(asked, before - most), before + most)
            through = np.where(_FREE, asked, 0.5 * (before + self._set))
            wanted = through[self._ramp_of]
            self._state = wanted + fade * (self._state - wanted)
            self._time = time if piece == pieces - 1 else self._time + step
            if self._time - self._times[self._stored - 1] >= _FINEST:
                self._store()

    def _store(self) -> None:
        if self._stored == 2 * _KEPT:
            self._times[:_KEPT] = self._times[_KEPT:]
            self._states[:_KEPT] = self._states[_KEPT:]
            self._stored = _KEPT
        self._times[self._stored] = self._time
        self._states[self._stored] = self._state
        self._stored += 1

    def observe(self, stamp: float, v: float, w: float) -> None:
        """Compare the encoders' velocities at a time [s] with all members."""
        elapsed, self._stamp = stamp - self._stamp, stamp
        times = self._times[: self._stored]
        asked = stamp - _DELAYS
        if self._stored < 2 or elapsed < _SHORTEST or asked[0] > times[-1] + 0.05:
            return
        after = np.clip(np.searchsorted(times, asked), 1, self._stored - 1)
        before = after - 1
        share = (asked - times[before]) / (times[after] - times[before])
        share = np.clip(share, 0.0, 1.0)[:, None]
        expected = self._states[before] + share * (self._states[after] - self._states[before])
        weight = min(1.0, elapsed / _SPACING)
        self._compare((v, w), (expected[_USUAL[0], _USUAL[1]], expected[_USUAL[0], _USUAL[2]]))
        self._see_if_held(stamp, v, w)
        if self.held:
            return
        linear = _LINEAR
        error = expected
        error[:, :linear] -= v
        error[:, linear:] -= w
        error *= error
        excitement = weight * np.array([np.ptp(error[:, :linear]), np.ptp(error[:, linear:])])
        excitement /= _NOISE**2
        spread = np.minimum(1.0, excitement)
        fade = 1.0 - weight * _SPACING / _MEMORY * spread
        self._evidence[:, :linear] *= fade[0]
        self._evidence[:, linear:] *= fade[1]
        # Wheels that are still getting up to speed have no room for a turn.
        if abs(v - self._command[0]) > _TRANSIENT:
            self._transient = stamp
        self.hurried = stamp - self._transient < _CALM
        if self.hurried:
            error[:, linear:] = 0.0
        self._evidence += weight * error

    def _see_if_held(self, stamp: float, v: float, w: float) -> None:
        """See if the robot does not answer at all; undo what its rest seemed to tell until then."""
        wanted_v, wanted_w = self._command
        wanted = wanted_v**2 + wanted_w**2
        self.unanswered = v * wanted_v + w * wanted_w < _ANSWER * wanted
        if not self.unanswered or self._answer is None:
            self._answer = stamp, self._evidence.copy()
        self.held = stamp - self._answer[0] > _PATIENCE
        if self.held:
            self._evidence[:] = self._answer[1]

    def _compare(self, found: tuple[float, float], expected: tuple[float, float]) -> None:
        """Add up how far the encoders go with what a usual robot would do."""
        for part, (encoder, usual) in enumerate(zip(found, expected, strict=True)):
            if abs(usual) > _MOVING:
                self._agreement[part] *= _KEEPS
                self._agreement[part] += (encoder * usual, usual * usual)

    @property
    def opposed(self) -> bool:
        """Return whether the encoders tell of motion the other way round."""
        return bool((self._agreement[:, 0] < _AGREE * self._agreement[:, 1]).any())

    def response(self) -> Response:
        """Return the weighted mean of the members, or the ideal response if it is as likely."""
        log_v, log_w = (
            -0.5 * part.reshape(len(_DELAYS), len(_LAGS), -1) / noise**2 - doubt * (slow > 0.0)
            for part, noise, doubt, slow in zip(
                np.split(self._evidence, [_LINEAR], axis=1), _NOISE, _DOUBT, _SLOW, strict=True
            )
        )
        prior = -(_DELAYS / 0.15)[:, None] - (_LAGS / 0.15)[None, :]
        log_v = log_v + prior[:, :, None]
        ideal = log_v[0, 0, 0] + log_w[0, 0, 0]
        # Each delay by its own scale, lest the likeliest of v and of w have no delay in common.
        top_v, top_w = log_v.max(axis=(1, 2)), log_w.max(axis=(1, 2))
        p_v, p_w = np.exp(log_v - top_v[:, None, None]), np.exp(log_w - top_w[:, None, None])
        kernel = np.exp(-0.5 * ((_LAGS[:, None] - _LAGS[None, :]) / _TOGETHER) ** 2)
        lags_v, lags_w = p_v.sum(axis=2), p_w.sum(axis=2)
        joint = lags_v[:, :, None] * kernel[None] * lags_w[:, None, :]  # delay, lag of v, lag of w
        likely = np.log(joint.sum(axis=(1, 2))) + top_v + top_w
        best = likely.max()
        joint *= np.exp(likely - best)[:, None, None] / joint.sum(axis=(1, 2))[:, None, None]
        if not best + math.log(joint.max()) - ideal > _SIGNIFICANT:
            return self._start
        joint /= joint.sum()
        delay, delay_spread = _moments(joint.sum(axis=(1, 2)), _DELAYS)
        lag_v, lag_v_spread = _moments(joint.sum(axis=(0, 2)), _LAGS)
        lag_w, lag_w_spread = _moments(joint.sum(axis=(0, 1)), _LAGS)
        ramp = _ramp(joint.sum(axis=2), p_v, _SLOWNESS)
        if ramp < math.inf:  # the wheels have one, and so does the turn
            unlike = np.log(np.maximum(_ANGULAR_SLOWNESS, _NO_SLOWNESS) * _LEVER * ramp) / _LEVERS
            p_w = p_w * np.exp(-0.5 * unlike * unlike)
        angular_ramp = _ramp(joint.sum(axis=1), p_w, _ANGULAR_SLOWNESS)
        spreads = (delay_spread, lag_v_spread, lag_w_spread)
        return Response(delay, lag_v, lag_w, ramp, angular_ramp, spreads)


def _ramp(likely: FloatArray, shares: FloatArray, slowness: FloatArray) -> float:
    """Return the mean ramp for weights of delays and lags (D, L), and of ramps with each."""
    weights = likely[:, :, None] * shares / np.maximum(shares.sum(axis=2), 1e-300)[:, :, None]
    slow, _ = _moments(weights.sum(axis=(0, 1)), slowness)
    return 1.0 / slow if slow > 0.8 * slowness[1] else math.inf


def _moments(weights: FloatArray, values: FloatArray) -> tuple[float, float]:
    """Return mean and standard deviation of values with weights that sum up to 1."""
    mean = float(weights @ values)
    return mean, math.sqrt(max(0.0, float(weights @ (values - mean) ** 2)))
