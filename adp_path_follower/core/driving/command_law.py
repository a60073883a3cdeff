"""From pose to command."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.basis import Expansion, Numbers
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.weights import LocalWeights


@dataclass(frozen=True)
class _Situation:
    """What the policy goes by where a robot is.

    Attributes:
        zeta: The state, shape (..., 4).
        curvature: kappa at the target [1/m], shape (...).
        v_des: Speed along the path there [m/s], shape (...); None where it does not vary.
        feedforward: [v_ss, w_ss], shape (..., 2).
        heading: cos and sin of the heading error, numbers of shape (...).
        expansion: sigma and sigma'.
        local: The weights.

    """

    zeta: FloatArray
    curvature: FloatArray
    v_des: FloatArray | None
    feedforward: FloatArray
    heading: Numbers
    expansion: Expansion
    local: LocalWeights


@dataclass(frozen=True)
class _Unforced:
    """How state and value change by themselves where a robot is.

    Attributes:
        drift: f, four numbers of shape (...).
        passing: How fast the value changes because the target moves on, shape (...).

    """

    drift: Numbers
    passing: FloatArray


def _product(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the inner products of vectors (..., L), shape (...)."""
    if first.ndim == second.ndim == 1:
        return np.asarray(first @ second)[()]
    return np.asarray((first * second).sum(-1))
