"""The paper's learner: one set of weights for the whole path, which the basis knows by phi.

The Bellman error of weights (Wc, Wa) at a state is delta = e^T Q e + u^T R u + Wc^T omega with
the regressor omega = sigma' (f + g u) and the actor's input u. At a sampled state everything but
the weights is constant, so a sweep over all samples is a few matrix products on arrays that are
prepared once.
"""

import numpy as np

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.bellman import BellmanErrors, Observation, bellman_errors
from adp_path_follower.core.learning.samples import sample_grid
from adp_path_follower.core.learning.update_laws import follow, least_squares, update_weights
from adp_path_follower.core.learning.weights import LearnedWeights, Weights, initial_weights
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings

_REST_STEP = 0.1  # [s] of learning at rest
_REST_STEPS = 6000
_SETTLED_CHANGE = 1e-9


class SampledModel:
    """The model of the error dynamics at a grid of sampled states, for Bellman extrapolation."""

    def __init__(self, settings: Settings, path: Path, profile: SpeedProfile) -> None:
        basis = settings.learning.value_basis
        self.states = sample_grid(
            settings.learning.sample_half_widths, settings.learning.samples_per_axis
        )
        arc_length = error_dynamics.arc_length_of(self.states[:, 3], settings.target)
        curvature = path.curvature(arc_length)
        v_des = profile.model_speed(arc_length)
        gradient = basis.gradient(self.states)
        drift = error_dynamics.drift(self.states, curvature, settings.target, v_des)
        self._limits = settings.limits
        self._feedforward = error_dynamics.feedforward(curvature, v_des).T
        self._drift_regressor = np.einsum("nlz,nz->nl", gradient, drift)  # sigma' f, (N, L)
        input_gradient = np.matmul(gradient, error_dynamics.input_matrix(self.states))
        # sigma' g with the two inputs first, (2, N, L): each product below is then contiguous.
        self._input_regressor = np.ascontiguousarray(input_gradient.transpose(2, 0, 1))
        count, size = self._drift_regressor.shape
        inverse_cost = settings.cost.inverse_input_cost()
        policy = -0.5 * np.einsum("ab,bnl->anl", inverse_cost, self._input_regressor)
        self._policy = np.ascontiguousarray(policy.reshape(2 * count, size).T)  # u = Wa @ policy
        error = self.states[:, :3]
        self._state_cost = np.einsum("ni,ij,nj->n", error, settings.cost.state_cost_matrix(), error)
        self._input_cost = settings.cost.input_cost_matrix().tolist()

    def __len__(self) -> int:
        """Return the number of samples N."""
        return len(self.states)

    def sweep(self, critic_weights: FloatArray, actor_weights: FloatArray) -> BellmanErrors:
        """Return the Bellman errors of weights (..., L) at all samples."""
        inputs = (actor_weights @ self._policy).reshape(*actor_weights.shape[:-1], 2, len(self))
        if not self._limits.unlimited:
            inputs = np.swapaxes(
                saturate(np.swapaxes(inputs, -1, -2), self._feedforward.T, self._limits), -1, -2
            )
        linear, angular = inputs[..., 0, :], inputs[..., 1, :]
        regressor = (
            self._drift_regressor
            + linear[..., None] * self._input_regressor[0]
            + angular[..., None] * self._input_regressor[1]
        )
        (vv, vw), (wv, ww) = self._input_cost
        running_cost = self._state_cost + linear * (vv * linear + vw * angular)
        running_cost = running_cost + angular * (wv * linear + ww * angular)
        return bellman_errors(critic_weights, regressor, running_cost)


class PathStateLearner:
    """Learns from the measured state and from a grid of samples, all of them in every step."""

    problem = ""  # the printed laws have no safe policy to fall back on

    def __init__(
        self, settings: Settings, riccati: RiccatiSchedule, weights: Weights | None
    ) -> None:
        """Start from weights, by default from the initial ones of the settings."""
        self._learning, self._path = settings.learning, riccati.path
        self._model = SampledModel(settings, riccati.path, riccati.profile)
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

    def local(self, arc_length: FloatArray) -> Weights:
        """Return the weights, which are the same everywhere."""
        return self.weights

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
        gain, bound = self._learning.actor_gain, self._learning.actor_weight_bound
        self.weights = Weights(critic, follow(self.weights.actor, critic, gain, bound, dt))

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

    def take_over(self, previous: object) -> None:
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
