"""A value function whose weights change along the path, learned for what lies ahead.

V(e, s_p) = w(s_p)^T sigma(e), with w linear between knots. The value function obeys

    0 = min_u e^T Q e + u^T R u + V_e (f + g u) + V_{s_p} s_p',

in which a place of the path is told what comes by the place ahead of it. So the learner goes
backwards, knot by knot, from the Riccati solution at the end of its preview to the robot, and
begins again: at each knot the critic takes the weights with the least Bellman errors for the
actor's policy, and the actor follows. One control step works off a fixed number of samples, so
its time is bounded however many samples and knots there are. When all ahead is learned, the learner
rests until the robot has come a few knots on. Until the first sweep over the whole preview, the
samples of one step must do for a knot: rough weights at once are better than good ones late.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.bellman import BellmanErrors
from adp_path_follower.core.learning.knot_critic import KnotTeacher
from adp_path_follower.core.learning.knot_model import KnotFit, KnotModel, NormalEquations
from adp_path_follower.core.learning.knot_weights import KnotMemory
from adp_path_follower.core.learning.learner import Learner, actor_bound
from adp_path_follower.core.learning.update_laws import follow, surely_finite
from adp_path_follower.core.learning.weights import LearnedWeights, LocalWeights
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings

_RESTS = 4  # while a robot comes to the end of what was ahead of it

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


def rest(settings: Settings, window: int) -> int:
    """Return after how many knots a learner that has learned all of its window learns anew.

    What a sweep of least squares finds depends only on where it begins and ends: at the same knot
    it would find the same. A gradient goes on from what it has found, and never rests.
    """
    return window // _RESTS if settings.learning.critic == "least_squares" else 0


class ArcLengthLearner:
    """Learns the weights at the knots ahead of the robot.

    `FleetLearner` does the same for each robot of a batch.

    Attributes:
        problem: Why the Riccati policy has taken over somewhere, empty if it has not.

    """

    def __init__(
        self,
        settings: Settings,
        path: Path,
        riccati: RiccatiSchedule,
        profile: SpeedProfile | None = None,
        memory: KnotMemory | None = None,
    ) -> None:
        """Start from the initial weights of the settings everywhere, kept in a memory."""
        learning = settings.learning
        self._settings, self._learning, self._path = settings, learning, path
        self._profile = profile if profile is not None else SpeedProfile(path, settings)
        self._size = len(learning.value_basis.labels)
        self._bound = actor_bound(learning, riccati)
        self._memory = memory or KnotMemory(settings, path, riccati, self._profile)
        self._spacing, self._window = self._memory.spacing, self._memory.window
        self._rest = rest(settings, self._window)
        self._model = KnotModel(settings, self._spacing, self._profile.varies)
        self._teacher = KnotTeacher(learning, len(self._model), self._memory)
        self.reset()

    def reset(self, where: np.ndarray | None = None) -> None:
        """Return to the initial weights; what robots share stays if only some (...) are lost."""
        if where is not None:
            return
        self._memory.reset()
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
        self._learned_from: int | None = None  # where all ahead of a knot was learned from

    @property
    def sampled(self) -> KnotFit:
        """Return what the samples said of the latest knot; not a number before the first."""
        return self._latest

    def local(self, arc_length: FloatArray) -> LocalWeights:
        """Return the weights at arc lengths [m] of any shape, and their slope along the path."""
        return self._memory.local(arc_length)

    def learn(self, measured: BellmanErrors, arc_length: FloatArray, dt: float) -> None:
        """Let the actor follow for dt [s], and work off some samples of the knot whose turn it is.

        Args:
            measured: Unused: what is learned at samples holds at the measured state as well.
            arc_length: Where the robots' targets are [m], any shape.
            dt: Period [s].

        """
        near, robots = self._span(arc_length)
        at_once = self._learning.samples_per_step
        if self._knot is None and not self._rests(near):
            self._enough = self._enough_samples(at_once)
            self._begin(near, robots + self._reach)
            whole = self._reach == self._window and self._enough == len(self._model)
            self._learned_from = near if whole else None
            self._reach = min(2 * self._reach + 1, self._window)
        if self._knot is not None:
            self._work(at_once, dt)
        self._follow(near, robots + self._window, dt)

    def _rests(self, near: int) -> bool:
        """Return whether enough is learned ahead of the knot behind the last robot."""
        return self._learned_from is not None and 0 <= near - self._learned_from < self._rest

    def _enough_samples(self, at_once: int) -> int:
        """Return how many samples make up a knot in the next sweep."""
        all_samples = len(self._model)
        rough = self._reach < self._window and self._learning.critic == "least_squares"
        # More unknowns than samples would have no single solution.
        return min(at_once, all_samples) if rough and at_once > self._size else all_samples

    def _span(self, arc_length: FloatArray) -> tuple[int, int]:
        """Return the knot behind the last robot and the one ahead of the first."""
        place = self._memory.position(arc_length)
        if place.size == 1:
            knot = math.floor(place.item())
            return knot, knot + 1
        return math.floor(place.min()), math.floor(place.max()) + 1

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
        comes_round = self._memory.lap is not None
        far = min(far, near + len(self._memory.critic) + (self._window if comes_round else 0))
        slots = self._memory.slots(np.arange(near, far))
        self._enough, self._learned_from = len(self._model), None
        self._begin(near, far)
        while self._knot is not None:
            self._work(len(self._model), math.inf)
        self._memory.actor[slots] = self._memory.critic[slots]
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
        self._memory, self._reach = previous._memory, previous._reach

    def learned(self) -> LearnedWeights:
        """Return the weights at the knots where something was learned."""
        return self._memory.learned(self._reach)

    def start_from(self, learned: LearnedWeights) -> str:
        """Go on from the weights of a run on a path of the same curvature, wherever it lay.

        Returns:
            Why this path is another one, empty if it is not.

        """
        problem = self._memory.start_from(learned)
        if not problem:
            self._reach = min(learned.reach, self._window)
        return problem

    def _begin(self, near: int, far: int) -> None:
        """Begin a sweep from the Riccati solution at knot `far` down to knot `near`."""
        self._near, self._length, self._refused = near, far - near, 0
        end = np.array([far])
        self._ahead = self._memory.safe(self._memory.curvature(end), self._memory.speed(end))[0]
        self._take(far - 1)

    def _take(self, knot: int) -> None:
        """Turn to a knot."""
        self._knot = knot
        memory = self._memory
        self._slot = int(memory.slots(np.array([knot]))[0])
        self._knot_curvature = float(memory.curvatures[self._slot])
        self._knot_speed = float(memory.speeds[self._slot])
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
        if self._refused:
            self._learned_from = None
        else:
            self.problem = ""
        self._knot = None

    def _finish(self, equations: NormalEquations) -> None:
        """Take over the critic of the present knot, or the Riccati solution in its place."""
        memory, slot = self._memory, self._slot
        elapsed = self._time * self._length
        lesson = self._teacher.lesson(
            equations, memory.critic[slot], elapsed, self._knot_curvature, self._knot_speed
        )
        self._latest = lesson.fit
        memory.critic[slot] = self._ahead = lesson.critic
        if lesson.refusal:
            self._refused += 1
            self.problem = lesson.refusal
            memory.actor[slot] = lesson.critic

    def _follow(self, near: int, far: int, dt: float) -> None:
        """Let the actor follow the critic at the knots from `near` up to `far`."""
        memory = self._memory
        slots = memory.slots(np.arange(near, far))
        actor, critic = memory.actor[slots], memory.critic[slots]
        if not surely_finite(actor, critic) and not np.isfinite([actor, critic]).all():
            self.problem = "weights are not finite"
            self._refused += 1
            memory.renew(np.arange(near, far))
            self._restart()
            return
        memory.actor[slots] = follow(actor, critic, self._learning.actor_gain, self._bound, dt)
