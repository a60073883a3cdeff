"""Updates the critic of one knot from its normal equations, or rejects the result.

With the matrix A and the vector b of the equations, least squares take Wc = -A^-1 b, and the
gradient follows Wc' = -eta (A Wc + b) / N.
"""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.knot_model import KnotFit, NormalEquations, fit
from adp_path_follower.core.learning.knot_weights import KnotWeights
from adp_path_follower.core.learning.update_laws import relax
from adp_path_follower.core.settings.learning import LearningSettings

_MOST_RESIDUAL = 0.5  # of the running cost: a critic that explains less is refused
_LEAST_EXCITATION = 1e-8  # above the ridge of the fit, which a singular matrix keeps


@dataclass(frozen=True)
class CriticUpdate:
    """The critic of a knot after its update."""

    # Wc from now on, shape (L,); the Riccati solution's if the update was refused.
    weights: FloatArray
    excitation: float  # the samples' certificate of excitation
    # Why the update was refused, empty if it was not; the actor takes `weights` as well.
    refusal: str


class KnotCritic:
    """Turns the normal equations of a knot into its new critic weights."""

    def __init__(self, learning: LearningSettings, samples: int, knots: KnotWeights) -> None:
        """Take gains and bounds, the number of samples, and where the Riccati solution is from."""
        self._learning, self._knots = learning, knots
        self._gain = learning.critic_gain_sampled / samples

    def update(
        self,
        equations: NormalEquations,
        weights: FloatArray,
        elapsed: float,
        curvature: float,
        speed: float,
    ) -> CriticUpdate:
        """Return Wc (L,) of a knot after an update; time [s], kappa [1/m], v_des [m/s] there."""
        found = fit(equations)
        refusal = self._refusal(found)
        if refusal:
            safe = self._knots.safe(np.array([curvature]), np.array([speed]))[0]
            return CriticUpdate(safe, found.excitation, refusal)
        if self._learning.critic == "gradient":
            descent = self._gain * (equations.matrix @ weights + equations.vector)
            step = relax(self._gain * equations.matrix, descent, min(elapsed, 1e3))
            return CriticUpdate(np.asarray(weights - step), found.excitation, "")
        return CriticUpdate(found.critic_weights, found.excitation, "")

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
