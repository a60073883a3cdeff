"""The paper's learner: one set of weights for the whole path, which the basis knows by phi."""

import numpy as np

from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.bellman import BellmanErrors
from adp_path_follower.core.learning.grid_model import SampledModel
from adp_path_follower.core.learning.learner import Learner, Observation, initial_weights
from adp_path_follower.core.learning.update_laws import follow, least_squares, update_weights
from adp_path_follower.core.learning.weights import LearnedWeights, LocalWeights, Weights
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings

_REST_STEP = 0.1  # [s] of learning at rest
_REST_STEPS = 6000
_SETTLED_CHANGE = 1e-9


class PathStateLearner:
    """Learns from the measured state and from a grid of samples, all of them in every step."""

    problem = ""  # the printed laws have no safe policy to fall back on

    def __init__(
        self,
        settings: Settings,
        path: Path,
        riccati: RiccatiSchedule,
        weights: Weights | None,
        profile: SpeedProfile | None = None,
    ) -> None:
        """Start from weights, by default from the initial ones of the settings."""
        self._learning, self._path = settings.learning, path
        self._model = SampledModel(settings, path, profile)
        speed = np.asarray(settings.target.desired_speed)
        self._initial = initial_weights(settings.learning, riccati, np.zeros(()), speed)
        self.weights = self._initial if weights is None else weights
        self._swept: tuple[Weights, BellmanErrors] | None = None

    @property
    def sampled(self) -> BellmanErrors:
        """Return the Bellman errors of the present weights at the samples."""
        if self._swept is None or self._swept[0] is not self.weights:
            found = self._model.sweep(self.weights.critic, self.weights.actor)
            self._swept = (self.weights, found)
        return self._swept[1]

    def local(self, arc_length: FloatArray) -> LocalWeights:
        """Return the weights, which are the same everywhere."""
        return LocalWeights(self.weights)

    def learn(self, observation: Observation, dt: float) -> None:
        """Learn for dt [s] from the Bellman errors at the measured state and at the samples."""
        if dt <= 0.0:
            return
        if self._learning.critic == "gradient":
            self.weights = update_weights(
                self.weights, observation.measure(), self.sampled, self._learning, dt
            )
            return
        critic = least_squares(self.weights, self.sampled)
        actor = follow(
            self.weights.actor,
            critic,
            self._learning.actor_gain,
            self._learning.actor_weight_bound,
            dt,
        )
        self.weights = Weights(critic, actor)

    def settle(self, observation: Observation) -> bool:
        """Learn with the robots at rest; return whether the weights settled."""
        settled = np.zeros((), bool)
        for _ in range(_REST_STEPS):
            before = self.weights
            self.learn(observation, _REST_STEP)
            if settled.any():  # those of a batch whose weights have settled are done
                self._keep(before, settled)
            change = np.abs(self.weights.critic - before.critic).max(axis=-1)
            change = np.maximum(change, np.abs(self.weights.actor - before.actor).max(axis=-1))
            settled = settled | (change < _SETTLED_CHANGE)
            if settled.all():
                return True
        return False

    def take_over(self, previous: Learner) -> None:
        """Take over the weights of another learner with the same basis."""
        if isinstance(previous, PathStateLearner) and (
            previous._learning.value_basis is self._learning.value_basis
        ):
            self.weights = previous.weights

    def learned(self) -> LearnedWeights:
        """Return the weights, as if of one place: they are the same everywhere."""
        critic, actor = self.weights.critic[None], self.weights.actor[None]
        nowhere = np.zeros(1, np.int64)
        length, closed = self._path.length, self._path.closed
        return LearnedWeights(length, closed, 0, nowhere, np.zeros(1), np.zeros(1), critic, actor)

    def start_from(self, learned: LearnedWeights) -> str:
        """Go on from the weights of another run, on whatever path."""
        if len(learned.knots) != 1:
            return f"it holds {len(learned.knots)} sets of weights, not one"
        self.weights = Weights(learned.critic[0], learned.actor[0])
        return ""

    def reset(self, where: np.ndarray | None = None) -> None:
        """Return to the initial weights, of the runs of a batch where (...) is true."""
        if where is None:
            self.weights = self._initial
            return
        self._keep(self._initial, where)

    def _keep(self, weights: Weights, where: np.ndarray) -> None:
        """Put weights in the place of the present ones, of the runs where (...) is true."""
        kept = where[..., None]
        self.weights = Weights(
            np.where(kept, weights.critic, self.weights.critic),
            np.where(kept, weights.actor, self.weights.actor),
        )
