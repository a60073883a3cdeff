"""Bellman errors, their regressors and the excitation certificate."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray


@dataclass(frozen=True)
class BellmanErrors:
    """Bellman errors at N states."""

    error: FloatArray  # delta, shape (..., N)
    regressor: FloatArray  # omega, shape (..., N, L)
    normalization: FloatArray  # p = sqrt(1 + omega^T omega), shape (..., N)

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


@dataclass(frozen=True)
class Observation:
    """The robots' places and measurements, of which a learner takes those that it needs."""

    arc_length: FloatArray  # where their targets are [m], shape (...)
    # Returns the Bellman errors of the present weights at the measured states.
    measure: Callable[[], BellmanErrors]
    # How far ahead of the targets to settle weights that change along the path [m].
    distance: float = 0.0


@dataclass(frozen=True)
class SampleEvidence:
    """How well the samples of each robot's latest knot determine its weights."""

    excitation: FloatArray  # the certificate, shape (...); not a number before the first knot


def bellman_errors(
    critic_weights: FloatArray, regressor: FloatArray, running_cost: FloatArray
) -> BellmanErrors:
    """Return the Bellman errors of regressors (..., N, L) with running costs (..., N)."""
    error = running_cost + np.matmul(regressor, critic_weights[..., None])[..., 0]
    normalization = np.sqrt(1.0 + np.einsum("...l,...l->...", regressor, regressor))
    return BellmanErrors(error, regressor, normalization)


def excitation(information: FloatArray) -> FloatArray:
    """Return the least eigenvalue of the information, above 0 under the paper's rank condition."""
    smallest = np.linalg.eigvalsh(information)[..., 0]
    return np.asarray(np.maximum(smallest, 0.0))  # rounding may pass zero
