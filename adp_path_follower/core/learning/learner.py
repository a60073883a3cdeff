"""The interface of a learner, and the weights and the bound that every learner starts from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray, Number
from adp_path_follower.core.learning.bellman import BellmanErrors
from adp_path_follower.core.learning.weights import LearnedWeights, LocalWeights, Weights
from adp_path_follower.core.settings.learning import LearningSettings


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


class Learner(Protocol):
    """Learns the value function, and the policy from it."""

    @property
    def problem(self) -> str:
        """Return why the safe policy has taken over, empty if it has not."""

    @property
    def sampled(self) -> BellmanErrors | SampleEvidence:
        """Return how well the samples determine the present weights."""

    def local(self, arc_length: FloatArray) -> LocalWeights:
        """Return the weights at arc lengths [m] of shape (...)."""

    def learn(self, observation: Observation, dt: float) -> None:
        """Learn for dt [s]."""

    def settle(self, observation: Observation) -> bool:
        """Learn with the robots at rest; return whether the weights settled."""

    def take_over(self, previous: Learner) -> None:
        """Take over another learner's weights, as far as they hold for this one."""

    def learned(self) -> LearnedWeights:
        """Return the learned weights, for another run to start from."""

    def start_from(self, learned: LearnedWeights) -> str:
        """Start from the weights of another run; return why not, empty if it did."""

    def reset(self, where: np.ndarray | None = None) -> None:
        """Return to the initial weights, of the runs of a batch where (...) is true."""


def actor_bound(learning: LearningSettings, riccati: RiccatiSchedule) -> float:
    """Return the norm that the projection keeps Wa below, above that of the Riccati solution."""
    safe = learning.value_basis.quadratic_weights(riccati.table)
    return max(learning.actor_weight_bound, float(np.linalg.norm(safe, axis=-1).max()))


def initial_weights(
    learning: LearningSettings,
    riccati: RiccatiSchedule,
    curvature: FloatArray,
    speed: Number,
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
