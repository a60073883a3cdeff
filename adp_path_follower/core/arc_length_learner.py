"""A value function whose weights change along the path, learned for what lies ahead.

V(e, s_p) = w(s_p)^T sigma(e), with w linear between knots. The value function obeys

    0 = min_u e^T Q e + u^T R u + V_e (f + g u) + V_{s_p} s_p',

in which a place of the path is told what comes by the place ahead of it. So the learner goes
backwards, knot by knot, from the Riccati solution at the end of its preview to the robot, and
begins again: at each knot the critic takes the weights with the least Bellman errors for the
actor's policy, and the actor follows. One control step works off a fixed number of samples, so
its time is bounded however many samples and knots there are. Until the first sweep over the whole
preview, the samples of one step must do for a knot: rough weights at once are better than good
ones late.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from adp_path_follower.core.bellman import BellmanErrors
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.knot_model import KnotFit, KnotModel, NormalEquations, fit
from adp_path_follower.core.learner import (
    LearnedWeights,
    Learner,
    LocalWeights,
    Weights,
    follow,
    initial_weights,
    relax,
)
from adp_path_follower.core.path import Path
from adp_path_follower.core.riccati import RiccatiSchedule
from adp_path_follower.core.settings import Settings
from adp_path_follower.core.speed_profile import SpeedProfile

_MOST_KNOTS = 8192  # that are remembered: 5 MB for each of critic and actor
_MOST_SPREAD = 500  # knots between robots of a batch that learn together
_FARTHEST = 1e12  # knots
_MOST_RESIDUAL = 0.5  # of the running cost: a critic that explains less is refused
_LEAST_EXCITATION = 1e-8  # above what the ridge of the fit leaves of a singular matrix
_SAME_CURVATURE = 1e-3  # [1/m], and relative: a path that differs less is the same
_SAME_SPEED = 1e-3  # relative
_SAME_LENGTH = 1e-4  # relative
_CURVATURE_NODES = np.linspace(-0.5, 0.5, 5)  # of a knot's interval, for its mean curvature
MODEL_SETTINGS = (  # that decide what is learned
    "basis",
    "basis_degree",
    "frame",
    "knot_spacing",
    "preview_distance",
    "sample_count",
    "sample_half_widths",
    "sample_seed",
    "initial_weights",
)


class ArcLengthLearner:
    """Learns the weights at the knots ahead of the robot, or of a batch of robots.

    A batch shares the weights: samples know nothing of the robot, so each would learn the same.

    Attributes:
        problem: Why the Riccati policy has taken over somewhere, empty if it has not.

    """

    def __init__(
        self,
        settings: Settings,
        path: Path,
        riccati: RiccatiSchedule,
        profile: SpeedProfile | None = None,
    ) -> None:
        """Start from the initial weights of the settings everywhere."""
        learning = settings.learning
        self._settings, self._learning, self._path = settings, learning, path
        self._riccati = riccati
        self._profile = profile if profile is not None else SpeedProfile(path, settings)
        self._size = len(learning.value_basis.labels)
        # Of the actor's projection: it never comes between the robot and its safe policy.
        safe = learning.value_basis.quadratic_weights(riccati.table)
        self._bound = max(learning.actor_weight_bound, float(np.linalg.norm(safe, axis=-1).max()))
        count = max(1, math.ceil(path.length / learning.knot_spacing))
        self._spacing = path.length / count if path.closed else learning.knot_spacing
        self._model = KnotModel(settings, self._spacing, self._profile.varies)
        self._window = max(2, round(learning.preview_distance / self._spacing))
        # An open path goes on straight beyond its ends, for one preview. The knots of a closed one
        # that fits into the memory come round again; of a longer one every lap has its own.
        self._ends = None if path.closed else (-self._window, count + 1 + self._window)
        self._lap = count if path.closed and count <= _MOST_KNOTS else None
        capacity = min(_MOST_KNOTS, count if path.closed else count + 2 + 2 * self._window)
        self._critic = np.zeros((capacity, self._size))
        self._actor = np.zeros((capacity, self._size))
        self._curvatures = np.zeros(capacity)
        self._speeds = np.zeros(capacity)
        self.reset()

    def reset(self, where: np.ndarray | None = None) -> None:
        """Return to the initial weights; of a batch, whose weights are shared, only as a whole.

        Robots of a batch where (...) is true are lost: nothing is learned where they are.
        """
        self._lost = where
        if where is not None:
            return
        self._owner = np.full(len(self._critic), np.iinfo(np.int64).min)
        self._reach = 0  # of the next sweep, growing to the window: where the robot is comes first
        self._enough = len(self._model)  # samples for a knot
        self._restart()
        self._latest = KnotFit(np.full(self._size, np.nan), math.nan, math.nan)
        self.problem = ""

    def _restart(self) -> None:
        """Begin the next sweep at the next step."""
        self._knot: int | None = None
        self._near = 0
        self._length = 0
        self._refused = 0

    @property
    def sampled(self) -> KnotFit:
        """Return what the samples said of the latest knot; not a number before the first."""
        return self._latest

    def local(self, arc_length: FloatArray) -> LocalWeights:
        """Return the weights at arc lengths [m] of any shape, and their slope along the path."""
        position = self._position(arc_length)
        knot = np.floor(position)
        share = (position - knot)[..., None]
        slots = self._slots(np.add.outer((0, 1), knot.astype(np.int64)))
        (critic, critic_ahead), (actor, actor_ahead) = self._critic[slots], self._actor[slots]
        critic_step = critic_ahead - critic
        actor = actor + share * (actor_ahead - actor)
        critic = critic + share * critic_step
        slope = critic_step / self._spacing
        if not (np.isfinite(actor).all() and np.isfinite(critic).all()):
            sound = np.isfinite(actor).all(axis=-1) & np.isfinite(critic).all(axis=-1)
            speed = self._profile.model_speed(arc_length)
            safe = self._safe(self._path.curvature(arc_length), speed)
            sound = sound[..., None]
            critic, actor = np.where(sound, critic, safe), np.where(sound, actor, safe)
            slope = np.where(sound, slope, 0.0)
        return LocalWeights(Weights(critic, actor), slope)

    def learn(self, measured: BellmanErrors, arc_length: FloatArray, dt: float) -> None:
        """Let the actor follow for dt [s], and work off some samples of the knot whose turn it is.

        Args:
            measured: Unused: what is learned at samples holds at the measured state as well.
            arc_length: Where the robots' targets are [m], any shape.
            dt: Period [s].

        """
        near, robots = self._span(arc_length)
        at_once = self._learning.samples_per_step
        if self._knot is None:
            self._enough = self._enough_samples(at_once)
            self._begin(near, robots + self._reach)
            self._reach = min(2 * self._reach + 1, self._window)
        self._work(at_once, dt)
        self._follow(near, robots + self._window, dt)

    def _enough_samples(self, at_once: int) -> int:
        """Return how many samples make up a knot in the next sweep."""
        all_samples = len(self._model)
        rough = self._reach < self._window and self._learning.critic == "least_squares"
        # More unknowns than samples would have no single solution.
        return min(at_once, all_samples) if rough and at_once > self._size else all_samples

    def _span(self, arc_length: FloatArray) -> tuple[int, int]:
        """Return the knot behind the last robot and the one ahead of the first.

        Robots far from most, such as one that is lost, are left to the initial weights.
        """
        place = self._position(arc_length)
        if place.size == 1:
            knot = math.floor(place.item())
            return knot, knot + 1
        known = np.isfinite(arc_length)
        if self._lost is not None:
            known = known & ~self._lost
        place = place[known] if known.any() else np.zeros(1)
        together = place[np.abs(place - np.median(place)) <= _MOST_SPREAD]
        return math.floor(together.min()), math.floor(together.max()) + 1

    def _position(self, arc_length: FloatArray) -> FloatArray:
        """Return arc lengths in knot spacings, same shape, within what integers can count."""
        place = np.where(np.isnan(arc_length), 0.0, arc_length)[()] / self._spacing
        return np.minimum(np.maximum(place, -_FARTHEST), _FARTHEST)

    def settle(
        self, measure: Callable[[], BellmanErrors], arc_length: FloatArray, distance: float
    ) -> bool:
        """Learn all that lies ahead; return whether the weights settled.

        Args:
            measure: Unused, as in `learn`.
            arc_length: Where the targets are [m], any shape.
            distance: How far ahead of them [m].

        """
        near, robots = self._span(arc_length)
        near -= self._window
        far = robots + math.ceil(distance / self._spacing) + self._window
        # All that the memory holds; round a lap, one preview more, which comes to lie under it.
        far = min(far, near + len(self._critic) + (0 if self._lap is None else self._window))
        slots = self._slots(np.arange(near, far))
        self._enough = len(self._model)
        self._begin(near, far)
        while self._knot is not None:
            self._work(len(self._model), math.inf)
        self._actor[slots] = self._critic[slots]
        self._reach = self._window
        return not self.problem

    def take_over(self, previous: Learner) -> None:
        """Take over the weights of a learner of the same path and problem."""
        if not isinstance(previous, ArcLengthLearner) or previous._path is not self._path:
            return
        old, new = previous._settings, self._settings
        if (old.target, old.cost, old.limits) != (new.target, new.cost, new.limits):
            return
        if not previous._profile.same_as(self._profile):
            return
        if any(
            getattr(old.learning, name) != getattr(new.learning, name) for name in MODEL_SETTINGS
        ):
            return
        self._critic, self._actor = previous._critic, previous._actor
        self._curvatures, self._speeds = previous._curvatures, previous._speeds
        self._owner, self._reach = previous._owner, previous._reach

    def learned(self) -> LearnedWeights:
        """Return the weights at the knots where something was learned."""
        known = self._owner != np.iinfo(np.int64).min
        sound = np.isfinite(self._critic).all(axis=1) & np.isfinite(self._actor).all(axis=1)
        slots = np.flatnonzero(known & sound)
        knots = self._owner[slots]
        if self._path.closed:  # every lap begins anew
            knots = knots % max(1, round(self._path.length / self._spacing))
        order = np.argsort(knots)
        slots = slots[order]
        return LearnedWeights(
            length=self._path.length,
            closed=self._path.closed,
            reach=self._reach,
            knots=knots[order],
            curvature=self._curvatures[slots],
            speed=self._speeds[slots],
            critic=self._critic[slots],
            actor=self._actor[slots],
        )

    def start_from(self, learned: LearnedWeights) -> str:
        """Go on from the weights of a run on a path of the same curvature, wherever it lay.

        Returns:
            Why this path is another one, empty if it is not.

        """
        path, knots = self._path, learned.knots
        if learned.closed != path.closed or not math.isclose(
            learned.length, path.length, rel_tol=_SAME_LENGTH
        ):
            kinds = {True: "a closed", False: "an open"}
            return (
                f"they were learned along {kinds[learned.closed]} path of {learned.length:.2f} m, "
                f"and this is {kinds[path.closed]} one of {path.length:.2f} m"
            )
        if not np.allclose(
            self._curvature(knots), learned.curvature, rtol=_SAME_CURVATURE, atol=_SAME_CURVATURE
        ):
            return "they were learned along a path that bends elsewhere than this one"
        if not np.allclose(self._speed(knots), learned.speed, rtol=_SAME_SPEED):
            return "they were learned at other speeds along the path than its profile has now"
        slots = knots % len(self._owner)
        if len(np.unique(slots)) < len(knots):
            return "they hold more places of the path than are remembered"
        self._owner[slots] = knots
        self._curvatures[slots], self._speeds[slots] = learned.curvature, learned.speed
        self._critic[slots], self._actor[slots] = learned.critic, learned.actor
        self._reach = min(learned.reach, self._window)
        return ""

    def _begin(self, near: int, far: int) -> None:
        """Begin a sweep from the Riccati solution at knot `far` down to knot `near`."""
        self._near, self._length, self._refused = near, far - near, 0
        end = np.array([far])
        self._ahead = self._safe(self._curvature(end), self._speed(end))[0]
        self._take(far - 1)

    def _take(self, knot: int) -> None:
        """Turn to a knot."""
        self._knot = knot
        self._slot = int(self._slots(np.array([knot]))[0])
        self._knot_curvature = float(self._curvatures[self._slot])
        self._knot_speed = float(self._speeds[self._slot]) if self._profile.varies else None
        self._done, self._time = 0, 0.0
        self._equations: NormalEquations | None = None

    def _work(self, count: int, dt: float) -> None:
        """Work off some samples of the present knot, and go on to the next when all are done."""
        assert self._knot is not None  # `_begin` took one
        end = min(self._done + count, self._enough)
        samples = slice(self._done, end)
        part = self._model.equations(samples, self._ahead, self._knot_curvature, self._knot_speed)
        self._equations = part if self._equations is None else self._equations + part
        self._done, self._time = end, self._time + dt
        if end < self._enough:
            return
        self._finish(self._equations)
        if self._knot > self._near:
            self._take(self._knot - 1)
            return
        if not self._refused:
            self.problem = ""
        self._knot = None

    def _finish(self, equations: NormalEquations) -> None:
        """Take over the critic of the present knot, or the Riccati solution in its place."""
        self._latest = fit(equations)
        refusal = self._refusal(self._latest)
        if refusal:
            self._refused += 1
            self.problem = refusal
            speed = None if self._knot_speed is None else np.array([self._knot_speed])
            safe = self._safe(np.array([self._knot_curvature]), speed)[0]
            self._critic[self._slot] = self._actor[self._slot] = self._ahead = safe
            return
        critic = self._latest.critic_weights
        if self._learning.critic == "gradient":
            critic = self._descended(equations)
        self._critic[self._slot] = self._ahead = critic

    def _descended(self, equations: NormalEquations) -> FloatArray:
        """Return the critic after the gradient law, over the time since the knot's last turn."""
        gain = self._learning.critic_gain_sampled / len(self._model)
        critic = self._critic[self._slot]
        descent = gain * (equations.matrix @ critic + equations.vector)
        elapsed = min(self._time * self._length, 1e3)
        return np.asarray(critic - relax(gain * equations.matrix, descent, elapsed))

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

    def _follow(self, near: int, far: int, dt: float) -> None:
        """Let the actor follow the critic at the knots from `near` up to `far`."""
        slots = self._slots(np.arange(near, far))
        actor, critic = self._actor[slots], self._critic[slots]
        if not (np.isfinite(actor).all() and np.isfinite(critic).all()):
            sound = np.isfinite(actor).all(axis=-1) & np.isfinite(critic).all(axis=-1)
            self.problem = "weights are not finite"
            self._refused += 1
            self._owner[slots[~sound]] = np.iinfo(np.int64).min
            self._slots(np.arange(near, far))
            self._restart()
            return
        self._actor[slots] = follow(actor, critic, self._learning.actor_gain, self._bound, dt)

    def _slots(self, knots: np.ndarray) -> np.ndarray:
        """Return where knots of any shape are stored, with initial weights if they are new."""
        if self._lap is not None:
            slots = number = knots % self._lap
        else:
            number = knots
            if self._ends is not None:
                number = np.minimum(np.maximum(knots, self._ends[0]), self._ends[1])
            slots = number % len(self._owner)
        new = self._owner[slots] != number
        if new.any():
            numbers = np.unique(number[new])
            places = numbers % len(self._owner)
            curvature, speed = self._curvature(numbers), self._speed(numbers)
            weights = initial_weights(self._learning, self._riccati, curvature, speed)
            self._critic[places], self._actor[places] = weights.critic, weights.actor
            self._curvatures[places], self._speeds[places] = curvature, speed
            self._owner[places] = numbers
        return np.asarray(slots)

    def _curvature(self, knots: np.ndarray) -> FloatArray:
        """Return the mean curvature [1/m] about each knot, shape (K,)."""
        arc_length = (knots[:, None] + _CURVATURE_NODES) * self._spacing
        return np.asarray(self._path.curvature(arc_length).mean(axis=1))

    def _speed(self, knots: np.ndarray) -> FloatArray:
        """Return the mean speed [m/s] about each knot, as models take it, shape (K,)."""
        arc_length = (knots[:, None] + _CURVATURE_NODES) * self._spacing
        return np.asarray(self._profile.model_speed(arc_length).mean(axis=1))

    def _safe(self, curvature: FloatArray, speed: FloatArray | None) -> FloatArray:
        """Return the Riccati solution's weights at curvatures and speeds (...), shape (..., L)."""
        basis = self._learning.value_basis
        return basis.quadratic_weights(self._riccati.matrix(curvature, speed))
