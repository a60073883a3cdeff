"""The Riccati policy, and where it takes over from the learned one.

Along the learned policy the learned value function changes by V' = delta - r, with the Bellman
error delta and the running cost r. While delta <= c r with c < 1, V falls at least by (1 - c) r, so
that a V that is not negative bounds the cost to come by V / (1 - c) (relaxed dynamic programming).
Where that does not hold, or V is much smaller than the Riccati solution's value, what was learned
is not to be trusted, and the Riccati policy drives.
"""

from __future__ import annotations

import numpy as np

from adp_path_follower.core.basis import half_angle_state, make_basis
from adp_path_follower.core.error_dynamics import input_matrix
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.policy import actor_input, saturate
from adp_path_follower.core.riccati import RiccatiSchedule
from adp_path_follower.core.settings import Settings

_ERROR_LEVELS = (0.5, 0.8)  # of the running cost: Bellman errors between trust and distrust
_VALUE_LEVELS = (0.5, 0.25)  # of the Riccati solution's value: learned values likewise
_NOTHING = 1e-12  # a running cost in which rounding decides


class RiccatiPolicy:
    """The policy of the value function q^T P q with q = [a, b, theta], the half-angle error."""

    def __init__(self, settings: Settings, riccati: RiccatiSchedule) -> None:
        """Take R, the limits and P along the path."""
        self._limits = settings.limits
        self._riccati = riccati
        inverse = np.linalg.inv(settings.cost.input_cost_matrix())
        self._input_cost_inverse: FloatArray = np.asarray(inverse, float)
        self._basis = make_basis("polynomial", 2, "half_angle")

    def modified_input(
        self, zeta: FloatArray, curvature: FloatArray, feedforward: FloatArray
    ) -> FloatArray:
        """Return u within the limits at states (..., 4), shape (..., 2)."""
        input_gradient = np.matmul(self._basis.gradient(zeta), input_matrix(zeta))
        weights = self._basis.quadratic_weights(self._riccati.matrix(curvature))
        wanted = actor_input(weights, input_gradient, self._input_cost_inverse)
        return saturate(wanted, feedforward, self._limits)

    def value(self, zeta: FloatArray, curvature: FloatArray) -> FloatArray:
        """Return q^T P q at states (..., 4), shape (...)."""
        half_angle_error = half_angle_state(zeta)[..., :3]
        pulled = np.matmul(self._riccati.matrix(curvature), half_angle_error[..., None])[..., 0]
        return np.asarray((half_angle_error * pulled).sum(axis=-1))


def distrust(
    bellman_error: FloatArray,
    running_cost: FloatArray,
    value: FloatArray,
    riccati_value: FloatArray,
) -> FloatArray:
    """Return from 0 to 1 how much of the Riccati policy a state needs, shape (...).

    Args:
        bellman_error: delta of the learned policy, shape (...).
        running_cost: r of the learned policy, shape (...).
        value: The learned value, shape (...).
        riccati_value: The Riccati solution's, shape (...).

    """
    low, high = _ERROR_LEVELS
    by_error = (bellman_error / (running_cost + _NOTHING) - low) / (high - low)
    low, high = _VALUE_LEVELS
    by_value = (value / (riccati_value + _NOTHING) - low) / (high - low)
    by_value = np.where(riccati_value > _NOTHING, by_value, 0.0)
    return np.asarray(np.minimum(np.maximum(np.maximum(by_error, by_value), 0.0), 1.0))
