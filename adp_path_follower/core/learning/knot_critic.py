"""What a knot of the path learns from its samples, and when that is not to be trusted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.knot_model import KnotFit, NormalEquations, fit
from adp_path_follower.core.learning.knot_weights import KnotMemory
from adp_path_follower.core.learning.update_laws import relax
from adp_path_follower.core.settings.learning import LearningSettings

_MOST_RESIDUAL = 0.5  # of the running cost: a critic that explains less is refused
_LEAST_EXCITATION = 1e-8  # above what the ridge of the fit leaves of a singular matrix


@dataclass(frozen=True)
class Lesson:
    """What a knot has learned.

    Attributes:
        critic: Wc of the knot from now on, shape (L,); the Riccati solution's if it was refused.
        fit: What the samples said.
        refusal: Why that was refused, empty if it was not; the actor then takes `critic` as well.

    """

    critic: FloatArray
    fit: KnotFit
    refusal: str


class KnotTeacher:
    """Draws the lesson from the normal equations of a knot."""

    def __init__(self, learning: LearningSettings, samples: int, memory: KnotMemory) -> None:
        """Take gains and bounds, the number of samples, and what knows the Riccati solution."""
        self._learning, self._memory = learning, memory
        self._gain = learning.critic_gain_sampled / samples

    def lesson(
        self,
        equations: NormalEquations,
        critic: FloatArray,
        elapsed: float,
        curvature: float,
        speed: float,
    ) -> Lesson:
        """Return what a knot learns.

        Args:
            equations: Of the samples that were worked off.
            critic: Wc of the knot so far, shape (L,).
            elapsed: Time since the knot's last turn [s].
            curvature: kappa [1/m] at the knot.
            speed: v_des [m/s] there.

        """
        found = fit(equations)
        refusal = self._refusal(found)
        if refusal:
            safe = self._memory.safe(np.array([curvature]), np.array([speed]))[0]
            return Lesson(safe, found, refusal)
        if self._learning.critic == "gradient":
            descent = self._gain * (equations.matrix @ critic + equations.vector)
            step = relax(self._gain * equations.matrix, descent, min(elapsed, 1e3))
            return Lesson(np.asarray(critic - step), found, "")
        return Lesson(found.critic_weights, found, "")

    def _refusal(self, found: KnotFit) -> str:
        """Return why a critic is not to be trusted, empty if it is."""
        bound = self._learning.actor_weight_bound
        norm = float(np.linalg.norm(found.critic_weights))
        if not math.isfinite(norm) or found.excitation < _LEAST_EXCITATION:
            return "the samples do not determine the weights (excitation certificate is zero)"
        if norm > bound:
            return f"the critic's weights have norm {norm:.3g}, above actor_weight_bound {bound:g}"
        if not found.residual <= _MOST_RESIDUAL:
            return (
                f"the Bellman errors at the samples are {found.residual:.0%} of the running cost, "
                f"above {_MOST_RESIDUAL:.0%}"
            )
        return ""
