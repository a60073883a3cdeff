"""Critic and actor weights, at one place and along a path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray


@dataclass(frozen=True)
class Weights:
    """Critic weights Wc and actor weights Wa, each of shape (..., L)."""

    critic: FloatArray
    actor: FloatArray


@dataclass(frozen=True)
class LocalWeights:
    """The value function at a place of the path.

    Attributes:
        weights: Critic and actor there, shape (..., L) each.
        slope: How the critic changes along the path [1/m], shape (..., L), or None if it is the
            same everywhere.

    """

    weights: Weights
    slope: FloatArray | None = None


@dataclass(frozen=True)
class LearnedWeights:
    """All that a learner has learned, to go on from in another run.

    Attributes:
        length: Of the path that it was learned on [m].
        closed: Whether that path ends where it starts.
        reach: How many knots ahead the next sweep reaches.
        knots: Numbers of the places along the path, rising, shape (K,).
        curvature: kappa [1/m] of the path there, shape (K,).
        speed: v_des [m/s] there, shape (K,).
        critic: Critic weights there, shape (K, L).
        actor: Actor weights there, shape (K, L).

    """

    length: float
    closed: bool
    reach: int
    knots: np.ndarray
    curvature: FloatArray
    speed: FloatArray
    critic: FloatArray
    actor: FloatArray
