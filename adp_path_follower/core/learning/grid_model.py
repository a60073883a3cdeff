"""Bellman errors, measured at the state and extrapolated to sampled states.

The Bellman error of weights (Wc, Wa) at a state is delta = e^T Q e + u^T R u + Wc^T omega with
the regressor omega = sigma' (f + g u) and the actor's input u. At a sampled state everything but
the weights is constant, so a sweep over all samples is a few matrix products on arrays that are
prepared once.
"""

import numpy as np

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.bellman import BellmanErrors, bellman_errors
from adp_path_follower.core.learning.samples import sample_grid
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.speed_profile import ConstantSpeed, SpeedProfile
from adp_path_follower.core.settings.groups import Settings


class SampledModel:
    """The model of the error dynamics at a grid of sampled states, for Bellman extrapolation."""

    def __init__(self, settings: Settings, path: Path, profile: SpeedProfile | None = None) -> None:
        """Prepare the terms without weights at each of N samples."""
        basis = settings.learning.value_basis
        self.states = sample_grid(
            settings.learning.sample_half_widths, settings.learning.samples_per_axis
        )
        arc_length = error_dynamics.arc_length_of(self.states[:, 3], settings.target)
        curvature = path.curvature(arc_length)
        v_des = (profile or ConstantSpeed(settings.target)).model_speed(arc_length)
        gradient = basis.gradient(self.states)
        drift = error_dynamics.drift(self.states, curvature, settings.target, v_des)
        self._limits = settings.limits
        self._feedforward = error_dynamics.feedforward(curvature, v_des).T
        self._drift_regressor = np.einsum("nlz,nz->nl", gradient, drift)  # sigma' f, (N, L)
        input_gradient = np.matmul(gradient, error_dynamics.input_matrix(self.states))
        # sigma' g with the two inputs first, (2, N, L): each product below is then contiguous.
        self._input_regressor = np.ascontiguousarray(input_gradient.transpose(2, 0, 1))
        count, size = self._drift_regressor.shape
        inverse_cost = settings.cost.inverse_input_cost()
        policy = -0.5 * np.einsum("ab,bnl->anl", inverse_cost, self._input_regressor)
        self._policy = np.ascontiguousarray(policy.reshape(2 * count, size).T)  # u = Wa @ policy
        error = self.states[:, :3]
        self._state_cost = np.einsum("ni,ij,nj->n", error, settings.cost.state_cost_matrix(), error)
        self._input_cost = settings.cost.input_cost_matrix()

    def __len__(self) -> int:
        """Return the number of samples N."""
        return len(self.states)

    def sweep(self, critic_weights: FloatArray, actor_weights: FloatArray) -> BellmanErrors:
        """Return the Bellman errors of weights (..., L) at all samples."""
        inputs = (actor_weights @ self._policy).reshape(*actor_weights.shape[:-1], 2, len(self))
        if not self._limits.unlimited:
            inputs = np.swapaxes(
                saturate(np.swapaxes(inputs, -1, -2), self._feedforward.T, self._limits), -1, -2
            )
        linear, angular = inputs[..., 0, :], inputs[..., 1, :]
        regressor = (
            self._drift_regressor
            + linear[..., None] * self._input_regressor[0]
            + angular[..., None] * self._input_regressor[1]
        )
        cost = self._input_cost
        running_cost = self._state_cost + linear * (cost[0, 0] * linear + cost[0, 1] * angular)
        running_cost = running_cost + angular * (cost[1, 0] * linear + cost[1, 1] * angular)
        return bellman_errors(critic_weights, regressor, running_cost)
