"""The policy u = -1/2 R^-1 g^T sigma'^T Wa, and the limits of the command."""

from typing import Any

import numpy as np

from adp_path_follower.core.geometry import FloatArray, clamped, components, numbers
from adp_path_follower.core.settings.groups import LimitSettings


def actor_input(
    actor_weights: FloatArray, input_gradient: FloatArray, input_cost_inverse: FloatArray
) -> FloatArray:
    """Return the modified input u = [v_e, w_e] of the actor, shape (..., 2).

    Takes Wa (..., L), sigma'(zeta) g(zeta) (..., L, 2) and R^-1 (2, 2).
    """
    descent = np.matmul(actor_weights[..., None, :], input_gradient)[..., 0, :]
    return descending_input(descent, input_cost_inverse)


def descending_input(descent: FloatArray, input_cost_inverse: FloatArray) -> FloatArray:
    """Return the modified input -1/2 R^-1 g^T V_zeta from g^T V_zeta, shape (..., 2) each."""
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
    if modified_input.ndim > 1 or feedforward.ndim > 1:
        return np.asarray(within(modified_input + feedforward, limits) - feedforward)
    (v_e, w_e), (v_ss, w_ss) = numbers(modified_input), numbers(feedforward)
    v, w = _clamped(v_e + v_ss, w_e + w_ss, limits)
    return components(v - v_ss, w - w_ss)


def within(command: FloatArray, limits: LimitSettings) -> FloatArray:
    """Return the command [v, w] that is nearest within the limits, shape (..., 2)."""
    if limits.unlimited:
        return command
    if command.ndim > 1:
        return np.asarray(np.minimum(np.maximum(command, limits.lower), limits.upper))
    v, w = numbers(command)
    return components(*_clamped(v, w, limits))


def _clamped(v: Any, w: Any, limits: LimitSettings) -> tuple[Any, Any]:
    """Return one robot's v and w within the limits."""
    lowest, highest = limits.lower.tolist(), limits.upper.tolist()
    return clamped(v, lowest[0], highest[0]), clamped(w, lowest[1], highest[1])
