"""Critic and actor update laws (paper, section III), integrated for any control period.

With the regressors held over one period, the critic's law is linear,

    Wc' = -(A Wc + b),   A = eta_c1 omega omega^T / p + eta_c2 / N sum_j omega_j omega_j^T / p_j.

The exact solution contracts eigenvectors by exp(-z) with z = lambda dt, the step by 1 / (1 + z +
z^2 / 2): the same to second order, and never beyond it. So it cannot diverge, and takes one
symmetric solve. The actor's law is a first-order lag, solved exactly.
"""

import functools
import math

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.bellman import BellmanErrors
from adp_path_follower.core.learning.weights import Weights
from adp_path_follower.core.settings.learning import LearningSettings

_PROJECTION_LAYER = 0.1  # thickness of the smooth projection's layer, relative to the bound
_RIDGE = 1e-9  # of least squares, on a unit diagonal


def update_weights(
    weights: Weights,
    measured: BellmanErrors,
    sampled: BellmanErrors,
    learning: LearningSettings,
    dt: float,
) -> Weights:
    """Return the weights after one period [s], from the Bellman errors at its start."""
    gain_measured = learning.critic_gain_measured
    gain_sampled = learning.critic_gain_sampled / sampled.error.shape[-1]
    rate = gain_measured * measured.information + gain_sampled * sampled.information
    descent = gain_measured * measured.gradient + gain_sampled * sampled.gradient
    critic = weights.critic - relax(rate, descent, dt)
    gain, bound = learning.actor_gain, learning.actor_weight_bound
    return Weights(critic, follow(weights.actor, critic, gain, bound, dt))


def least_squares(weights: Weights, sampled: BellmanErrors) -> FloatArray:
    """Return Wc (..., L) of the least normalised Bellman errors, near zero where undetermined."""
    scaled = sampled.regressor / sampled.normalization[..., None]
    constant = sampled.error - np.einsum("...nl,...l->...n", sampled.regressor, weights.critic)
    matrix = np.matmul(np.swapaxes(scaled, -1, -2), scaled)
    vector = np.einsum("...nl,...n->...l", scaled, constant / sampled.normalization)
    size = np.einsum("...ll->...l", matrix)
    matrix = matrix + _RIDGE * (size + 1e-12)[..., None] * np.eye(matrix.shape[-1])
    return np.asarray(_solve(matrix, -vector))


def follow(
    actor_weights: FloatArray, critic_weights: FloatArray, gain: float, bound: float, dt: float
) -> FloatArray:
    """Return Wa (..., L) after following Wc by eta_a [1/s] for a time [s], with a bounded norm."""
    step = critic_weights - actor_weights
    step *= -math.expm1(-gain * dt)
    actor = actor_weights + step
    # Inside the ball the projection changes nothing; all weights together are a quicker answer.
    if all(np.vdot(weights, weights) <= bound**2 for weights in (actor_weights, actor)):
        return actor
    if all((weights**2).sum(-1).max() <= bound**2 for weights in (actor_weights, actor)):
        return actor
    return bound_norm(actor_weights + project(step, actor_weights, bound), bound)


def relax(rate: FloatArray, descent: FloatArray, dt: float) -> FloatArray:
    """Return how far W' = -(A W + b) moves W down in one step [s], shape (..., L).

    `rate` is A [1/s], symmetric positive semidefinite, (..., L, L); `descent` is A W + b at the
    start of the step, (..., L).
    """
    # The step is dt N(z) descent with N(z) = (1 - 1 / (1 + z + z^2/2)) / z = Re + Im of
    # 1 / (z + 1 - i): one complex solve, without squaring the matrix and its condition.
    solution = _solve(dt * rate + _shift(rate.shape[-1]), descent)
    return np.asarray(dt * (solution.real + solution.imag))


@functools.cache  # to make it takes as long as to solve with it
def _shift(size: int) -> np.ndarray:
    """Return 1 - i times the unit matrix."""
    return (1.0 - 1.0j) * np.eye(size)


def _solve(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the solutions of linear systems (..., L, L), NaN of those that have none."""
    try:
        return np.asarray(np.linalg.solve(matrix, vector[..., None])[..., 0])
    except np.linalg.LinAlgError:  # one robot's numbers are broken: it must not stop others
        if matrix.ndim == 2:
            return np.full_like(vector, np.nan, dtype=matrix.dtype)
        return np.stack([_solve(*pair) for pair in zip(matrix, vector, strict=True)])


def project(step: FloatArray, actor_weights: FloatArray, bound: float) -> FloatArray:
    """Return the step after the smooth projection proj{.}, shape (..., L).

    Inside the ball ‖Wa‖ <= bound, and for steps that lead inwards, nothing changes. In a layer
    around it the outward part of the step fades out, and is gone at its outer edge.
    """
    squared_norm = np.einsum("...l,...l->...", actor_weights, actor_weights)
    outer = (1.0 + _PROJECTION_LAYER) * bound
    depth = np.clip((squared_norm - bound**2) / (outer**2 - bound**2), 0.0, 1.0)
    outward = np.einsum("...l,...l->...", actor_weights, step)
    removed = depth * np.maximum(outward, 0.0) / np.maximum(squared_norm, 1e-300)
    return np.asarray(step - removed[..., None] * actor_weights)


def bound_norm(actor_weights: FloatArray, bound: float) -> FloatArray:
    """Return weights within the projection's outer edge, which a finite step can pass."""
    norm = np.linalg.norm(actor_weights, axis=-1, keepdims=True)
    outer = (1.0 + _PROJECTION_LAYER) * bound
    return np.asarray(actor_weights * np.minimum(1.0, outer / np.maximum(norm, 1e-300)))
