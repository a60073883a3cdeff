"""Bellman errors, measured at the state and extrapolated to sampled states.

The Bellman error of weights (Wc, Wa) at a state is delta = e^T Q e + u^T R u + Wc^T omega with
the regressor omega = sigma' (f + g u) and the actor's input u. At a sampled state everything but
the weights is constant, so a sweep over all samples is a few matrix products on arrays that are
prepared once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adp_path_follower.core import error_dynamics
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path import Path
from adp_path_follower.core.policy import saturate
from adp_path_follower.core.settings import Settings
from adp_path_follower.core.speed_profile import SpeedProfile


@dataclass(frozen=True)
class BellmanErrors:
    """Bellman errors at N states.

    Attributes:
        error: delta, shape (..., N).
        regressor: omega, shape (..., N, L).
        normalization: p = sqrt(1 + omega^T omega), shape (..., N).

    """

    error: FloatArray
    regressor: FloatArray
    normalization: FloatArray

    @property
    def information(self) -> FloatArray:
        """Return the rank condition's matrix, sum_j omega_j omega_j^T / p_j, shape (..., L, L)."""
        scaled = self.regressor / self.normalization[..., None]
        return np.asarray(np.matmul(np.swapaxes(scaled, -1, -2), self.regressor))

    @property
    def gradient(self) -> FloatArray:
        """Return sum_j omega_j delta_j / p_j, shape (..., L)."""
        scaled = self.error / self.normalization
        return np.asarray(np.matmul(scaled[..., None, :], self.regressor)[..., 0, :])

    @property
    def excitation(self) -> FloatArray:
        """Return the smallest singular value of the rank condition's matrix, shape (...)."""
        return excitation(self.information)


def bellman_errors(
    critic_weights: FloatArray, regressor: FloatArray, running_cost: FloatArray
) -> BellmanErrors:
    """Return the Bellman errors of regressors (..., N, L) with running costs (..., N)."""
    error = running_cost + np.matmul(regressor, critic_weights[..., None])[..., 0]
    normalization = np.sqrt(1.0 + np.einsum("...l,...l->...", regressor, regressor))
    return BellmanErrors(error, regressor, normalization)


class SampledModel:
    """The model of the error dynamics at a grid of sampled states, for Bellman extrapolation."""

    def __init__(self, settings: Settings, path: Path, profile: SpeedProfile | None = None) -> None:
        """Prepare what does not depend on the weights at every sample (N of them)."""
        basis = settings.learning.value_basis
        self.states = sample_grid(
            settings.learning.sample_half_widths, settings.learning.samples_per_axis
        )
        arc_length = error_dynamics.arc_length_of(self.states[:, 3], settings.target)
        curvature = path.curvature(arc_length)
        varies = profile is not None and profile.varies
        v_des = profile.model_speed(arc_length) if profile is not None and varies else None
        gradient = basis.gradient(self.states)
        drift = error_dynamics.drift(self.states, curvature, settings.target, v_des)
        self._limits = settings.limits
        self._feedforward = error_dynamics.feedforward(curvature, settings.target, v_des).T
        self._drift_regressor = np.einsum("nlz,nz->nl", gradient, drift)  # sigma' f, (N, L)
        input_gradient = np.matmul(gradient, error_dynamics.input_matrix(self.states))
        # sigma' g with the two inputs first, (2, N, L): each product below is then contiguous.
        self._input_regressor = np.ascontiguousarray(input_gradient.transpose(2, 0, 1))
        count, size = self._drift_regressor.shape
        inverse_cost = np.linalg.inv(settings.cost.input_cost_matrix())
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


def excitation(information: FloatArray) -> FloatArray:
    """Return the certificate of excitation: the smallest singular value of the information.

    The matrix is symmetric and positive semidefinite, so this is its smallest eigenvalue; it is
    above zero where the samples determine every weight (the paper's rank condition).
    """
    smallest = np.linalg.eigvalsh(information)[..., 0]
    return np.asarray(np.maximum(smallest, 0.0))  # rounding may pass zero


def sample_grid(half_widths: tuple[float, ...], samples_per_axis: tuple[int, ...]) -> FloatArray:
    """Return the grid of sampled states about the origin, shape (N, 4)."""
    axes = [
        np.linspace(-width, width, count) if count > 1 else np.zeros(1)
        for width, count in zip(half_widths, samples_per_axis, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
