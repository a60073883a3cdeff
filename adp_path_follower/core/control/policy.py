"""The policy u = -1/2 R^-1 g^T sigma'^T Wa, and the limits of the command."""

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import LimitSettings


def actor_input(
    actor_weights: FloatArray, input_gradient: FloatArray, input_cost_inverse: FloatArray
) -> FloatArray:
    """Return u = [v_e, w_e] (..., 2) by Wa (..., L), sigma' g (..., L, 2) and R^-1 (2, 2)."""
    descent = np.matmul(actor_weights[..., None, :], input_gradient)[..., 0, :]
    return descending_input(descent, input_cost_inverse)


def descending_input(descent: FloatArray, input_cost_inverse: FloatArray) -> FloatArray:
    """Return the modified input -1/2 R^-1 g^T V_zeta from g^T V_zeta, shape (..., 2) each."""
    return np.asarray(-0.5 * descent.dot(input_cost_inverse))


def saturate(
    modified_input: FloatArray, feedforward: FloatArray, limits: LimitSettings
) -> FloatArray:
    """Return the modified input whose command stays within the limits, shape (..., 2).

    For a diagonal R this is the exact minimiser of the Hamiltonian over the box, so the Bellman
    error of the clipped input is the constrained problem's.
    """
    if limits.unlimited:
        return modified_input
    return within(modified_input + feedforward, limits) - feedforward


def within(command: FloatArray, limits: LimitSettings) -> FloatArray:
    """Return the command [v, w] that is nearest within the limits, shape (..., 2)."""
    if limits.unlimited:
        return command
    return np.minimum(np.maximum(command, limits.lower), limits.upper)
