"""The policy u = -1/2 R^-1 g^T sigma'^T Wa, and the limits of the command."""

from __future__ import annotations

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings import LimitSettings


def actor_input(
    actor_weights: FloatArray, input_gradient: FloatArray, input_cost_inverse: FloatArray
) -> FloatArray:
    """Return the modified input u = [v_e, w_e] of the actor, shape (..., 2).

    Args:
        actor_weights: Wa, shape (..., L).
        input_gradient: sigma'(zeta) g(zeta), shape (..., L, 2).
        input_cost_inverse: R^-1, shape (2, 2).

    """
    descent = np.matmul(actor_weights[..., None, :], input_gradient)[..., 0, :]
    return np.asarray(-0.5 * (descent @ input_cost_inverse))


def saturate(
    modified_input: FloatArray, feedforward: FloatArray, limits: LimitSettings
) -> FloatArray:
    """Return the modified input whose command stays within the limits, shape (..., 2).

    For a diagonal R this is the exact minimiser of the Hamiltonian over the box, so the Bellman
    error of the clipped input is the constrained problem's.
    """
    if limits.unlimited:
        return modified_input
    command = modified_input + feedforward
    command = np.minimum(np.maximum(command, limits.lower), limits.upper)
    return np.asarray(command - feedforward)
