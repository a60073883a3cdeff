"""Critic and actor update laws (paper, section III), integrated for any control period.

With the regressors held over one period, the critic's law is linear,

    Wc' = -(A Wc + b),   A = eta_c1 omega omega^T / p + eta_c2 / N sum_j omega_j omega_j^T / p_j,

with a symmetric positive semidefinite A. Its exact solution contracts each eigenvector by
exp(-lambda dt). The step here contracts by 1 / (1 + z + z^2 / 2) with z = lambda dt: equal to
the exponential to second order, and between it and 1 for every z, so a step never overshoots the
exact solution and never diverges, however long the period or large the gain. It needs one
symmetric solve. The actor's law is a first-order lag, solved exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.bellman import BellmanErrors
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings import LearningSettings

_PROJECTION_LAYER = 0.1  # thickness of the smooth projection's layer, relative to the bound


@dataclass(frozen=True)
class Weights:
    """Critic weights Wc and actor weights Wa, each of shape (..., L)."""

    critic: FloatArray
    actor: FloatArray

    @classmethod
    def initial(cls, learning: LearningSettings) -> Weights:
        """Return the weights that the settings start from."""
        return cls(
            np.array(learning.initial_critic_weights), np.array(learning.initial_actor_weights)
        )


def update_weights(
    weights: Weights,
    measured: BellmanErrors,
    sampled: BellmanErrors,
    learning: LearningSettings,
    dt: float,
) -> Weights:
    """Return the weights after one period.

    Args:
        weights: Weights at the start of the period.
        measured: Bellman error of these weights at the measured state.
        sampled: Bellman errors of these weights at the sampled states.
        learning: Gains and bounds.
        dt: Period [s].

    """
    gain_measured = learning.critic_gain_measured
    gain_sampled = learning.critic_gain_sampled / sampled.error.shape[-1]
    rate = gain_measured * measured.information + gain_sampled * sampled.information
    descent = gain_measured * measured.gradient + gain_sampled * sampled.gradient
    critic = weights.critic - relax(rate, descent, dt)
    step = -math.expm1(-learning.actor_gain * dt) * (critic - weights.actor)
    actor = weights.actor + project(step, weights.actor, learning.actor_weight_bound)
    return Weights(critic, bound_norm(actor, learning.actor_weight_bound))


def relax(rate: FloatArray, descent: FloatArray, dt: float) -> FloatArray:
    """Return how far W' = -(A W + b) moves W down in one step, shape (..., L).

    Args:
        rate: A [1/s], symmetric positive semidefinite, shape (..., L, L).
        descent: A W + b at the start of the step, shape (..., L).
        dt: Step [s].

    """
    # The step is dt N(z) descent with N(z) = (1 - 1 / (1 + z + z^2/2)) / z = Re + Im of
    # 1 / (z + 1 - i): one complex solve, without squaring the matrix and its condition.
    matrix = dt * rate + (1.0 - 1.0j) * np.eye(rate.shape[-1])
    solution = np.linalg.solve(matrix, descent[..., None])[..., 0]
    return np.asarray(dt * (solution.real + solution.imag))


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
