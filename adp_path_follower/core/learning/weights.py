"""Critic and actor weights, at one place and along a path."""

from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray, Number
from adp_path_follower.core.settings.learning import LearningSettings


@dataclass(frozen=True)
class Weights:
    """Critic weights Wc and actor weights Wa at a place of the path, each of shape (..., L)."""

    critic: FloatArray
    actor: FloatArray
    slope: FloatArray | None = None  # of Wc along the path [1/m], (..., L); None: none


@dataclass(frozen=True)
class LearnedWeights:
    """All that a learner has learned, to go on from in another run."""

    length: float  # of the path that it was learned on [m]
    closed: bool  # whether that path ends where it starts
    reach: int  # how many knots ahead the next sweep reaches
    knots: np.ndarray  # numbers of the places along the path, rising, shape (K,)
    curvature: FloatArray  # kappa [1/m] of the path there, shape (K,)
    speed: FloatArray  # v_des [m/s] there, shape (K,)
    critic: FloatArray  # critic weights there, shape (K, L)
    actor: FloatArray  # actor weights there, shape (K, L)


def initial_weights(
    learning: LearningSettings, riccati: RiccatiSchedule, curvature: FloatArray, speed: Number
) -> Weights:
    """Return the first weights at curvatures [1/m] and speeds [m/s] (...), shape (..., L)."""
    size = len(learning.value_basis.labels)
    if learning.initial_weights == "riccati":
        weights = learning.value_basis.quadratic_weights(riccati.matrix(curvature, speed))
        return Weights(weights, weights.copy())

    def listed(values: tuple[float, ...]) -> FloatArray:
        padded = np.array([*values, *[0.0] * (size - len(values))])
        return np.broadcast_to(padded, (*curvature.shape, size)).copy()

    return Weights(listed(learning.initial_critic_weights), listed(learning.initial_actor_weights))
