"""Learns knot by knot, backwards along the path: from the Riccati solution at the end of a preview.

The weights of knot k have the least Bellman errors for the policy of knot k + 1, which is ahead of
it. With least squares they depend on nothing else, so robots near one another share a sweep. With
the matrix A and the vector b of a knot's normal equations, least squares take Wc = -A^-1 b, and the
gradient follows Wc' = -eta (A Wc + b) / N.
"""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.knot_model import KnotFit, KnotModel, NormalEquations, fit
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


class Sweep:
    """The critic updates of the knots from the one before `far` back to `near`."""

    def __init__(self, near: int, far: int, samples: int, ahead: FloatArray) -> None:
        """Begin with Wc of the knot `far`, shape (L,)."""
        self.near, self.far, self.samples = near, far, samples
        self.updates: list[CriticUpdate] = []  # of knots far - 1, far - 2, ...
        self._ahead = ahead
        self._done = 0  # samples of the next knot
        self._equations: NormalEquations | None = None  # of those

    def work(self, model: KnotModel, until: int, curvature: float, speed: float) -> None:
        """Add the samples of the next knot up to number `until` to its equations."""
        if until <= self._done:
            return
        samples = slice(self._done, until)
        part = model.equations(samples, self._ahead, curvature, speed)
        self._equations = part if self._equations is None else self._equations + part
        self._done = until

    def finish(self, critic: KnotCritic, weights: FloatArray, *knot: float) -> None:
        """Update the critic weights of the next knot, as `KnotCritic.update`."""
        assert self._equations is not None  # there are samples
        update = critic.update(self._equations, weights, *knot)
        self.updates.append(update)
        self._ahead = update.weights
        self._done, self._equations = 0, None


@dataclass
class Group:
    """Robots that began the same sweep in the same step, and go through it together."""

    robots: np.ndarray  # their indices, shape (n,)
    sweep: Sweep
    index: int = 0  # how many of its knots they have passed
    # Where their weights of the present knot are stored, shape (n,).
    slots: np.ndarray | None = None
    done: int = 0  # how many samples of that knot are used for them
    time: float = 0.0  # how long they have been at it [s]
    refused: int = 0  # how many of its knots kept the Riccati solution

    def keep(self, chosen: np.ndarray) -> None:
        """Let only the robots (n,) that are true stay in the group."""
        self.robots = self.robots[chosen]
        self.slots = None if self.slots is None else self.slots[chosen]

    @property
    def ended(self) -> bool:
        """Return whether all knots are passed."""
        return self.index == self.sweep.far - self.sweep.near
