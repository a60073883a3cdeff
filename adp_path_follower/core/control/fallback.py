"""The Riccati policy, and where it takes over from the learned one.

Along the learned policy the learned value function changes by V' = delta - r, with the Bellman
error delta and the running cost r. While delta <= c r with c < 1, V falls at least by (1 - c) r, so
that a V that is not negative bounds the cost to come by V / (1 - c) (relaxed dynamic programming).
Where that does not hold, or V is much smaller than the Riccati solution's value, the learned policy
is doubtful, and the Riccati policy drives. But V rises also where a limit binds, or the speed along
the path falls faster than V can know. That is no fault of the learner's, and no doubt, where the
Riccati policy would drive much the same.
"""

import math

import numpy as np

from adp_path_follower.core.basis import half_angle_state, make_basis
from adp_path_follower.core.control.error_dynamics import input_matrix
from adp_path_follower.core.control.policy import actor_input, saturate
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray, Number, clamped, where
from adp_path_follower.core.settings.groups import Settings

# Shares of the running cost: the Bellman error of a policy that is trusted, and what an input costs
# more than the Riccati policy's where it is much the same.
_MOST_ERROR = _MUCH_THE_SAME = 0.5
# A smaller share of the Riccati solution's value, which knows no bend ahead, is doubtful.
_LEAST_VALUE = 0.1
_NOTHING = 0.005  # [m], [rad]: smaller errors do not matter, and approximations decide their cost
_ROUNDING = 1e-12  # a cost in which rounding decides
_PROBATION = 0.5  # [s] without doubt, before the learned policy drives again
_CHANGE_TIME = 0.2  # [s] from one policy to the other


class RiccatiPolicy:
    """The policy of the value function q^T P q with q = [a, b, theta], the half-angle error."""

    def __init__(self, settings: Settings, riccati: RiccatiSchedule) -> None:
        self._limits = settings.limits
        self._riccati = riccati
        self._input_cost_inverse = settings.cost.inverse_input_cost()
        self._basis = make_basis("polynomial", 2, "half_angle")

    def modified_input(
        self, zeta: FloatArray, curvature: FloatArray, feedforward: FloatArray
    ) -> FloatArray:
        """Return u within the limits at states (..., 4) for [v_ss, w_ss], shape (..., 2)."""
        input_gradient = np.matmul(self._basis.gradient(zeta), input_matrix(zeta))
        matrix = self._riccati.matrix(curvature, feedforward[..., 0])
        weights = self._basis.quadratic_weights(matrix)
        wanted = actor_input(weights, input_gradient, self._input_cost_inverse)
        return saturate(wanted, feedforward, self._limits)

    def value(self, zeta: FloatArray, curvature: FloatArray, v_des: Number) -> FloatArray:
        """Return q^T P q at states (..., 4), shape (...)."""
        half_angle_error = half_angle_state(zeta)[..., :3]
        matrix = self._riccati.matrix(curvature, v_des)
        if half_angle_error.ndim == 1:
            value: FloatArray = half_angle_error.dot(matrix).dot(half_angle_error)
            return value
        pulled = np.matmul(matrix, half_angle_error[..., None])[..., 0]
        return np.asarray((half_angle_error * pulled).sum(axis=-1))


class Distrust:
    """Decides, robot by robot, when the Riccati policy drives in place of the learned one.

    A mixture of two policies, each of which leads to the path, can stand still where the two
    cancel. So only one drives: after a doubt the Riccati policy drives until there has been none
    for a while, and each change takes a moment.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the past: the next decision takes effect at once."""
        self._share: FloatArray | None = None
        self._trusted_for: Number = math.inf

    def share(self, doubtful: np.ndarray, dt: float) -> FloatArray:
        """Return how much of the Riccati policy drives, from 0 to 1, dt [s] later, shape (...)."""
        self._trusted_for = where(doubtful, 0.0, self._trusted_for + dt)
        wanted = where(self._trusted_for < _PROBATION, 1.0, 0.0)
        if self._share is None:
            self._share = wanted
        else:
            step = dt / _CHANGE_TIME
            self._share = self._share + clamped(wanted - self._share, -step, step)
        return np.asarray(self._share)[()]


class Fallback:
    """Lets the Riccati policy drive where the learned one is doubtful."""

    def __init__(self, settings: Settings, riccati: RiccatiSchedule) -> None:
        self._policy, self._distrust = RiccatiPolicy(settings, riccati), Distrust()
        self.reset = self._distrust.reset
        self._watches = settings.policy.fallback != "none"
        nothing = np.full(3, _NOTHING)
        self._input_cost = settings.cost.input_cost_matrix()
        self._nothing = float(nothing @ settings.cost.state_cost_matrix() @ nothing)

    def doubt(
        self,
        bellman_error: FloatArray,
        running_cost: FloatArray,
        value: FloatArray,
        learned: FloatArray,
        drives: np.ndarray,
        dt: float,
        zeta: FloatArray,
        curvature: FloatArray,
        feedforward: FloatArray,
    ) -> FloatArray:
        """Return the share of the Riccati policy from 0 to 1, dt [s] after the last, shape (...).

        Bellman error delta, running cost r and value, shape (...) each, are those of the learned
        policy's input (..., 2) at states zeta (..., 4), where the path has kappa [1/m] and
        [v_ss, w_ss] (..., 2). There is no doubt of a policy that does not drive (...), as another
        one does so far from the path, and never with `fallback: none`.
        """
        if not self._watches:
            return np.zeros_like(running_cost)
        riccati_value = self._policy.value(zeta, curvature, feedforward[..., 0])
        doubtful = is_doubtful(bellman_error, running_cost, value, riccati_value, self._nothing)
        doubtful = doubtful & drives
        if doubtful.any():
            safe = self._policy.modified_input(zeta, curvature, feedforward)
            apart = learned - safe  # costs at least (apart)^T R (apart), by the Riccati value
            lost = (apart @ self._input_cost * apart).sum(axis=-1)
            doubtful &= lost > _MUCH_THE_SAME * running_cost + self._nothing
        return self._distrust.share(doubtful, dt)

    def undoubted(self, shape: tuple[int, ...], dt: float) -> FloatArray:
        """Return the doubt of policies of which none drives, shape (...)."""
        trusted = np.zeros(shape, bool)[()]
        return self._distrust.share(trusted, dt) if self._watches else np.zeros(shape)

    def blend(
        self,
        learned: FloatArray,
        doubt: FloatArray,
        zeta: FloatArray,
        curvature: FloatArray,
        feedforward: FloatArray,
    ) -> FloatArray:
        """Return the input, shape (..., 2): the Riccati policy's as far as there is doubt."""
        if not doubt.any():
            return learned
        safe = self._policy.modified_input(zeta, curvature, feedforward)
        return learned + doubt[..., None] * (safe - learned)


def is_doubtful(
    bellman_error: FloatArray,
    running_cost: FloatArray,
    value: FloatArray,
    riccati_value: FloatArray,
    nothing: float = 0.0,
) -> np.ndarray:
    """Return where the learned value function does not decrease as it must, shape (...).

    Bellman error delta, running cost r and value are those of the learned policy, shape (...) each;
    `nothing` is a cost, and a rate of cost, that is as good as none.
    """
    nothing += _ROUNDING
    rises = bellman_error > _MOST_ERROR * running_cost + nothing
    small: np.ndarray = value < _LEAST_VALUE * riccati_value - nothing
    doubtful: np.ndarray = rises | small
    return doubtful
