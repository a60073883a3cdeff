"""Learning along the path for a batch of robots, each as if it were alone.

What a sweep of least squares over the knots finds depends only on where it begins and ends: its
samples know nothing of the robot, nor of what was learned before. Robots that are near one another
sweep the same knots, at once or one after the other, and what a sweep finds is computed once for
all of them. The weights are each robot's own, as its actor follows the critic while it is near.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.bellman import BellmanErrors
from adp_path_follower.core.learning.knot_critic import KnotTeacher, Lesson
from adp_path_follower.core.learning.knot_model import KnotModel
from adp_path_follower.core.learning.knot_weights import FleetMemory, KnotMemory
from adp_path_follower.core.learning.learner import Learner, actor_bound
from adp_path_follower.core.learning.path_learner import ArcLengthLearner, rest
from adp_path_follower.core.learning.update_laws import follow
from adp_path_follower.core.learning.weights import LearnedWeights, LocalWeights, Weights
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings

_MOST_LESSONS = 20_000  # that are remembered: 20 MB with 80 weights
_AT_ONCE = 16  # robots whose actors follow at once: what that takes fits into the caches


@dataclass(frozen=True)
class FleetEvidence:
    """What the samples said of each robot's latest knot; not a number before the first.

    Attributes:
        excitation: The certificate, shape (...).

    """

    excitation: FloatArray


@dataclass
class _Sweep:
    """What is found on the way from the knot before `far` to the knot `near`.

    Attributes:
        near: The last knot.
        far: The knot ahead of the first.
        samples: How many samples make up a knot.
        ahead: Wc of the knot ahead of the next one, shape (L,).
        lessons: Of the knots far - 1, far - 2, ..., as far as they have been needed.

    """

    near: int
    far: int
    samples: int
    ahead: FloatArray
    lessons: list[Lesson] = field(default_factory=list)


class FleetLearner:
    """What an `ArcLengthLearner` is to one robot, to each robot of a batch."""

    def __init__(
        self,
        settings: Settings,
        path: Path,
        riccati: RiccatiSchedule,
        profile: SpeedProfile,
        shape: tuple[int, ...],
    ) -> None:
        """Start from the initial weights of the settings everywhere.

        Args:
            settings: All settings.
            path: The path.
            riccati: The Riccati solution along it.
            profile: The speed along it.
            shape: Of the batch.

        """
        self._settings, self._learning = settings, settings.learning
        self._path, self._riccati, self._profile = path, riccati, profile
        self._shape, self._count = shape, int(np.prod(shape))
        self._bound = actor_bound(settings.learning, riccati)
        self._memory = FleetMemory(settings, path, riccati, profile, self._count)
        self._window = self._memory.window
        self._rest = rest(settings, self._window)
        self._model = KnotModel(settings, self._memory.spacing, profile.varies)
        self._teacher = KnotTeacher(settings.learning, len(self._model), self._memory)
        self._shares = settings.learning.critic == "least_squares"
        self._sweeps: dict[int, _Sweep] = {}
        self._known: dict[tuple[int, ...], int] = {}  # which sweep begins and ends like that
        self._begun = 0
        self._start()

    def _start(self) -> None:
        """Begin as somebody who has learned nothing."""
        count = self._count
        self._memory.reset()
        self._reach = np.zeros(count, np.int64)  # as of the learner of a single robot
        self._sweep = np.full(count, -1)  # which one each robot is at; -1: at none
        # Its ends; knots that are done.
        self._near, self._far, self._index = np.zeros((3, count), np.int64)
        self._length, self._samples, self._done = np.zeros((3, count), np.int64)
        self._time = np.zeros(count)  # [s] since the turn to the present knot
        self._refused = np.zeros(count, bool)  # something in the present sweep
        self._complete = np.zeros(count, bool)  # the last one, and nothing of it refused
        self._problems: dict[int, str] = {}  # by robot
        self._excitation = np.full(count, np.nan)

    def reset(self, where: np.ndarray | None = None) -> None:
        """Return to the initial weights, of the robots where (...) is true."""
        if where is None:
            self._start()
            return
        lost = np.broadcast_to(where, self._shape).ravel()
        self._memory.forget_robots(lost)
        self._reach[lost] = 0
        self._sweep[lost], self._complete[lost] = -1, False

    @property
    def problem(self) -> str:
        """Return why the Riccati policy has taken over for a robot, empty if it has for none."""
        return next(iter(self._problems.values()), "")

    @property
    def sampled(self) -> FleetEvidence:
        """Return what the samples said of each robot's latest knot."""
        return FleetEvidence(self._excitation.reshape(self._shape))

    def local(self, arc_length: FloatArray) -> LocalWeights:
        """Return each robot's weights at its arc length [m], and their slope along the path."""
        found = self._memory.local(arc_length.ravel())

        def shaped(values: FloatArray) -> FloatArray:
            return values.reshape(*self._shape, -1)

        assert found.slope is not None  # weights change along the path
        weights = Weights(shaped(found.weights.critic), shaped(found.weights.actor))
        return LocalWeights(weights, shaped(found.slope))

    def learn(self, measured: BellmanErrors, arc_length: FloatArray, dt: float) -> None:
        """Let actors follow for dt [s], and work off some samples of the knots whose turn it is.

        Args:
            measured: Unused, as by the learner of a single robot.
            arc_length: Where the robots' targets are [m], of the batch's shape.
            dt: Period [s].

        """
        near = self._knots(arc_length)
        passed = near - self._near
        resting = self._complete & (passed >= 0) & (passed < self._rest)
        idle = np.flatnonzero((self._sweep < 0) & ~resting)
        if len(idle):
            self._begin(idle, near[idle])
        self._done = np.minimum(self._done + self._learning.samples_per_step, self._samples)
        self._time += dt
        finished = np.flatnonzero((self._sweep >= 0) & (self._done >= self._samples))
        if len(finished):
            self._finish(finished)
        self._follow(near, dt)

    def _knots(self, arc_length: FloatArray) -> np.ndarray:
        """Return the knot behind each robot, shape (B,)."""
        return np.floor(self._memory.position(arc_length.ravel())).astype(np.int64)

    def _begin(self, robots: np.ndarray, near: np.ndarray) -> None:
        """Let robots with indices (n,) begin the sweeps that end at knots `near` (n,)."""
        reach, everything = self._reach[robots], len(self._model)
        far = near + 1 + reach
        at_once = min(self._learning.samples_per_step, everything)
        may_be_rough = self._shares and self._learning.samples_per_step > self._memory.size
        samples = np.where((reach < self._window) & may_be_rough, at_once, everything)
        who = robots if not self._shares else np.zeros_like(robots)
        keys = np.stack([near, far, samples, who], axis=1)
        distinct, which = np.unique(keys, axis=0, return_inverse=True)
        self._forget_sweeps()
        ends = self._memory.ends(distinct[:, 1])
        sweeps = [
            self._sweep_of(tuple(key), ahead)
            for key, ahead in zip(distinct.tolist(), ends, strict=True)
        ]
        self._sweep[robots] = np.array(sweeps)[which.ravel()]
        self._reach[robots] = np.minimum(2 * reach + 1, self._window)
        self._near[robots], self._far[robots], self._length[robots] = near, far, far - near
        self._samples[robots] = samples
        self._index[robots] = self._done[robots] = 0
        self._time[robots], self._refused[robots] = 0.0, False

    def _sweep_of(self, key: tuple[int, ...], ahead: FloatArray) -> int:
        """Return the number of the sweep with a key, a new one from `ahead` if there is none."""
        if self._shares and key in self._known:
            return self._known[key]
        near, far, samples, _ = key
        self._begun += 1
        self._sweeps[self._begun] = _Sweep(near, far, samples, ahead)
        self._known[key] = self._begun
        return self._begun

    def _forget_sweeps(self) -> None:
        """Forget sweeps that no robot is at, if there are too many, or none will come again."""
        kept = sum(len(sweep.lessons) for sweep in self._sweeps.values())
        if self._shares and kept <= _MOST_LESSONS:
            return
        used = set(self._sweep.tolist())
        self._sweeps = {number: self._sweeps[number] for number in used if number >= 0}
        self._known = {key: number for key, number in self._known.items() if number in used}

    def _finish(self, robots: np.ndarray) -> None:
        """Let robots with indices (n,) take over the critics of their knots, and go on."""
        memory, index = self._memory, self._index[robots]
        turn = np.minimum(self._index, self._length - 1)  # those who rest are at no knot
        slots = memory.slots(self._far - 1 - turn)[robots]
        turns = self._sweep[robots] * (1 + index.max()) + index
        _, first, which = np.unique(turns, return_index=True, return_inverse=True)
        lessons = [self._lesson(int(robots[one]), int(slots[one])) for one in first]
        critics = np.array([lesson.critic for lesson in lessons])[which]
        memory.critic[slots] = critics
        self._excitation = self._excitation.copy()  # others hold the one before
        self._excitation[robots] = np.array([item.fit.excitation for item in lessons])[which]
        refused = np.array([bool(lesson.refusal) for lesson in lessons])[which]
        if refused.any():
            memory.actor[slots[refused]] = critics[refused]
            self._refused[robots[refused]] = True
            for place in np.flatnonzero(refused):
                self._problems[int(robots[place])] = lessons[which[place]].refusal
        self._index[robots] += 1
        self._done[robots], self._time[robots] = 0, 0.0
        ended = robots[self._index[robots] == self._length[robots]]
        self._sweep[ended] = -1
        everything = (self._length > self._window) & (self._samples == len(self._model))
        self._complete[ended] = (everything & ~self._refused)[ended]
        if self._problems:
            for robot in ended[~self._refused[ended]].tolist():
                self._problems.pop(robot, None)

    def _lesson(self, robot: int, slot: int) -> Lesson:
        """Return what the knot in a slot of a robot has learned, computed if it is the first."""
        sweep, index = self._sweeps[int(self._sweep[robot])], int(self._index[robot])
        if index < len(sweep.lessons):
            return sweep.lessons[index]
        assert index == len(sweep.lessons)  # one after the other
        curvature = float(self._memory.curvatures[slot])
        speed = float(self._memory.speeds[slot])
        at_once, equations = self._learning.samples_per_step, None
        for start in range(0, sweep.samples, at_once):
            samples = slice(start, min(start + at_once, sweep.samples))
            part = self._model.equations(samples, sweep.ahead, curvature, speed)
            equations = part if equations is None else equations + part
        assert equations is not None  # there are samples
        elapsed = float(self._time[robot]) * int(self._length[robot])
        critic = self._memory.critic[slot]
        lesson = self._teacher.lesson(equations, critic, elapsed, curvature, speed)
        sweep.lessons.append(lesson)
        sweep.ahead = lesson.critic
        return lesson

    def _follow(self, near: np.ndarray, dt: float) -> None:
        """Let each actor follow its critic at the knots ahead of knots `near` (B,)."""
        memory, learning = self._memory, self._learning
        knots = near + np.arange(self._window + 1)[:, None]
        slots = np.ascontiguousarray(memory.slots(knots).T)
        unsound = np.zeros(self._count, bool)
        for start in range(0, self._count, _AT_ONCE):
            some = slice(start, start + _AT_ONCE)
            actor, critic = memory.actor[slots[some]], memory.critic[slots[some]]
            followed = follow(actor, critic, learning.actor_gain, self._bound, dt)
            if np.isfinite(followed.sum()):
                memory.actor[slots[some]] = followed
                continue
            sound = np.isfinite(actor).all(axis=(1, 2)) & np.isfinite(critic).all(axis=(1, 2))
            memory.actor[slots[some][sound]] = followed[sound]
            unsound[some] = ~sound
        if unsound.any():
            self._problems.update(dict.fromkeys(np.flatnonzero(unsound), "weights are not finite"))
            memory.renew(knots)
            self._sweep[unsound], self._complete[unsound] = -1, False

    def settle(
        self, measure: Callable[[], BellmanErrors], arc_length: FloatArray, distance: float
    ) -> bool:
        """Learn all that lies ahead of every robot, anew; return whether the weights settled.

        Args:
            measure: Unused, as in `learn`.
            arc_length: Where the targets are [m], of the batch's shape.
            distance: How far ahead of them [m].

        """
        near, settled = self._knots(arc_length), True
        self._excitation = self._excitation.copy()
        for knot in np.unique(near):  # robots at the same place learn the same
            robots = np.flatnonzero(near == knot)
            memory = KnotMemory(self._settings, self._path, self._riccati, self._profile)
            alone = ArcLengthLearner(
                self._settings, self._path, self._riccati, self._profile, memory
            )
            settled &= alone.settle(measure, arc_length.ravel()[robots[:1]], distance)
            self._problems = {**self._problems, **dict.fromkeys(robots.tolist(), alone.problem)}
            self._memory.copy_from(memory, robots)
            self._excitation[robots] = alone.sampled.excitation
        self._problems = {robot: text for robot, text in self._problems.items() if text}
        self._reach[:] = self._window
        self._sweep[:], self._complete[:] = -1, False
        return settled

    def take_over(self, previous: Learner) -> None:
        """Take over nothing: the settings of a batch do not change while it drives."""

    def learned(self) -> LearnedWeights:
        """Return what the first robot has learned."""
        return self._memory.learned(int(self._reach[0]))

    def start_from(self, learned: LearnedWeights) -> str:
        """Let every robot go on from the weights of one; return why they do not hold, if so."""
        problem = self._memory.start_from(learned)
        if not problem:
            self._reach[:] = min(learned.reach, self._window)
        return problem
