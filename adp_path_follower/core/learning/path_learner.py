"""Learns a value function whose weights change along the path, for one robot or for a batch.

V(e, s_p) = w(s_p)^T sigma(e), with w linear between knots, obeys

    0 = min_u e^T Q e + u^T R u + V_e (f + g u) + V_{s_p} s_p',

so the value depends on the value ahead. A sweep goes backwards, knot by knot, from the Riccati
solution at the end of the preview to the robot: the critic takes the least Bellman errors for the
actor's policy, and the actor follows. A step uses a fixed number of samples, so its time is
bounded. In the first sweep a knot has the samples of one step: rough weights at once are better
than good ones late. Later the learner rests until the robot has passed a few knots. Each robot has
weights of its own; those that sweep the same knots share the sweep.
"""

import math

import numpy as np

from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.bellman import Observation, SampleEvidence
from adp_path_follower.core.learning.knot_model import knot_model
from adp_path_follower.core.learning.knot_weights import KnotWeights
from adp_path_follower.core.learning.paper_learner import PathStateLearner
from adp_path_follower.core.learning.sweep import Group, KnotCritic, Sweep
from adp_path_follower.core.learning.update_laws import follow
from adp_path_follower.core.learning.weights import LearnedWeights, Weights
from adp_path_follower.core.settings.groups import Settings

_REST_SHARE = 4  # a learner rests while its robot passes one of so many parts of the preview
_MOST_UPDATES = 20_000  # that all sweeps together remember: 20 MB with 80 weights
_AT_ONCE = 16  # robots whose actors follow at once, so that their weights fit into the caches
# Share of a sweep's knots: at the odd one, as before a sharp bend, the Riccati solution serves.
_MOST_REFUSED = 0.25
_NEVER = np.iinfo(np.int64).max // 2  # a knot that no robot reaches

MODEL_SETTINGS = (  # that decide the weights
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


class PathLearner:
    """Learns the weights at the knots ahead of each robot of a batch; one robot has shape ()."""

    def __init__(
        self, settings: Settings, riccati: RiccatiSchedule, shape: tuple[int, ...] = ()
    ) -> None:
        """Start from the settings' initial weights; robots that do not learn may share them."""
        learning = settings.learning
        self._settings, self._learning, self._riccati = settings, learning, riccati
        self._shape, self._count = shape, math.prod(shape)
        # The actor's norm may be that of the Riccati solution's weights at least.
        safe = learning.value_basis.quadratic_weights(riccati.table)
        self._bound = max(learning.actor_weight_bound, float(np.linalg.norm(safe, axis=-1).max()))
        self._knots = KnotWeights(settings, riccati, self._count)
        self._window = self._knots.window
        self._model = knot_model(settings, self._knots.spacing, riccati.profile.varies)
        self._critic = KnotCritic(learning, len(self._model), self._knots)
        # The result of a least-squares sweep depends only on where it begins and ends: robots can
        # share it, and need no other one soon. A gradient goes on from its last weights.
        self._shares = learning.critic == "least_squares"
        self._rest = self._window // _REST_SHARE if self._shares else 0  # [knots]
        self._sweeps: dict[tuple[int, int], Sweep] = {}  # by near and far
        self._start()

    def _start(self) -> None:
        """Return to the state before any learning."""
        self._knots.reset()
        # For each robot: how far its next sweep reaches, which grows to the window because near
        # knots come first; whether it is on a sweep; the knot from which all ahead was learned.
        self._reach = np.zeros(self._count, np.int64)
        self._busy = np.zeros(self._count, bool)
        self._learned_from = np.full(self._count, _NEVER)
        self._groups: list[Group] = []
        self._problems: dict[int, str] = {}  # by robot
        # How well the samples determined the weights of each robot's latest knot.
        self.sampled = SampleEvidence(np.full(self._shape, np.nan))
        self._resting_at = b""  # the knots about the robots while all of them rest
        self._followed = self._slots = np.zeros((0, 0), np.int64)  # knots whose actors follow

    def reset(self, where: np.ndarray | None = None) -> None:
        """Return to the initial weights, of the robots where (...) is true.

        Robots that share their weights keep them, if only some of them are to return.
        """
        if where is None:
            self._start()
        elif where.shape == self._shape:
            lost = where.ravel()
            self._knots.forget(lost)
            self._reach[lost] = 0
            self._stop(lost)

    def _stop(self, robots: np.ndarray) -> None:
        """Let the robots (B,) that are true leave their sweeps, and begin anew."""
        self._busy[robots], self._learned_from[robots] = False, _NEVER
        self._resting_at = b""
        for group in self._groups:
            group.keep(~robots[group.robots])
        self._groups = [group for group in self._groups if len(group.robots)]

    @property
    def problem(self) -> str:
        """Return why the Riccati policy has taken over for a robot, empty if it has for none."""
        return next(iter(self._problems.values()), "")

    def local(self, arc_length: FloatArray) -> Weights:
        """Return each robot's weights at its arc length [m], and their slope along the path."""
        if arc_length.ndim < 2:  # as the knots have them
            return self._knots.local(arc_length)
        found = vars(self._knots.local(arc_length.ravel())).values()
        return Weights(*(values.reshape(*arc_length.shape, -1) for values in found))

    def learn(self, observation: Observation, dt: float) -> None:
        """Let actors follow for dt [s], and use some samples of the knots whose turn it is."""
        near, ahead = self._span(observation)
        place = near.tobytes() + ahead.tobytes()
        if place != self._resting_at:
            self._begin(near, ahead)
            self._resting_at = b"" if self._groups else place
            for group in self._groups:
                self._work(group, self._learning.samples_per_step, dt)
            self._groups = [group for group in self._groups if not group.ended]
            spread = int(ahead[0] - near[0])  # 1 unless robots share their weights
            self._followed = near + np.arange(spread + self._window)[:, None]
            self._slots = np.ascontiguousarray(self._knots.slots(self._followed).T)
        self._follow(dt)

    def _span(self, observation: Observation) -> tuple[np.ndarray, np.ndarray]:
        """Return the knots behind and ahead of each robot, or of all that share weights, (B,)."""
        position = np.floor(self._knots.position(observation.arc_length))
        behind = position.reshape(-1, self._count).astype(np.int64)
        if len(behind) == 1:
            return behind[0], behind[0] + 1
        return behind.min(axis=0), behind.max(axis=0) + 1

    def _begin(self, near: np.ndarray, ahead: np.ndarray) -> None:
        """Begin sweeps of idle robots, from their reach beyond `ahead` (B,) down to `near` (B,)."""
        resting = (near >= self._learned_from) & (near < self._learned_from + self._rest)
        idle = np.flatnonzero(~(self._busy | resting))
        if not len(idle):
            return
        if sum(len(sweep.updates) for sweep in self._sweeps.values()) > _MOST_UPDATES:
            used = [group.sweep for group in self._groups]
            self._sweeps = {(sweep.near, sweep.far): sweep for sweep in used}
        far = ahead + self._reach
        for start, end, robots in self._together(idle, near, far):
            self._groups.append(Group(robots, self._sweep(start, end)))
        whole = idle[self._reach[idle] == self._window]
        self._learned_from[whole] = near[whole]
        self._reach[idle] = np.minimum(2 * self._reach[idle] + 1, self._window)
        self._busy[idle] = True

    def _together(
        self, robots: np.ndarray, near: np.ndarray, far: np.ndarray
    ) -> list[tuple[int, int, np.ndarray]]:
        """Return `near`, `far` and indices of each group that learns the same between them."""
        found: dict[tuple[int, int, int], list[int]] = {}
        for robot in robots.tolist():
            # A gradient goes on from weights that are the same only before there are any.
            alone = -1 if self._shares or self._reach[robot] == 0 else robot
            found.setdefault((int(near[robot]), int(far[robot]), alone), []).append(robot)
        return [(start, end, np.array(group)) for (start, end, _), group in found.items()]

    def _sweep(self, near: int, far: int) -> Sweep:
        """Return the sweep from knot `far` down to `near`, begun by another robot or new."""
        sweep = self._sweeps.get((near, far))
        if sweep is None:
            everything, at_once = len(self._model), self._learning.samples_per_step
            # More unknowns than samples would have no single solution.
            rough = far - near <= self._window and self._shares and at_once > self._knots.size
            samples = min(at_once, everything) if rough else everything
            sweep = Sweep(near, far, samples, self._knots.end(far))
            if self._shares and self._count > 1:  # one robot shares with none
                self._sweeps[near, far] = sweep
        return sweep

    def _work(self, group: Group, count: int, dt: float) -> None:
        """Use some samples of a group's knot, and go on to the next when all are used."""
        sweep, knots = group.sweep, self._knots
        if group.slots is None:
            group.slots = knots.slots(np.array([sweep.far - 1 - group.index]), group.robots)
        group.done, group.time = min(group.done + count, sweep.samples), group.time + dt
        if group.index == len(sweep.updates):  # no other group has been here
            first = group.slots[0]
            curvature = float(knots.curvatures[first])
            speed = float(knots.speeds[first])
            sweep.work(self._model, group.done, curvature, speed)
            if group.done == sweep.samples:
                elapsed = group.time * (sweep.far - sweep.near)
                sweep.finish(self._critic, knots.critic[first], elapsed, curvature, speed)
        if group.done == sweep.samples:
            self._pass_knot(group)

    def _pass_knot(self, group: Group) -> None:
        """Let a group take over the critic of its knot, and turn to the next."""
        update, knots, robots = group.sweep.updates[group.index], self._knots, group.robots
        knots.critic[group.slots] = update.weights
        excitation = self.sampled.excitation.copy()  # outputs hold the one before
        excitation.reshape(-1)[robots] = update.excitation
        self.sampled = SampleEvidence(excitation)
        if update.refusal:
            knots.actor[group.slots] = update.weights
            group.refused += 1
        group.index += 1
        group.slots, group.done, group.time = None, 0, 0.0
        if not group.ended:
            return
        self._busy[robots] = False
        if group.refused:
            self._learned_from[robots] = _NEVER
        if group.refused > _MOST_REFUSED * group.index:
            refusal = next(filter(None, (made.refusal for made in group.sweep.updates)))
            self._problems.update(dict.fromkeys(robots.tolist(), refusal))
        elif self._problems:
            for robot in robots.tolist():
                self._problems.pop(robot, None)

    def _follow(self, dt: float) -> None:
        """Let each actor follow its critic at the knots ahead of its robot."""
        knots, learning = self._knots, self._learning
        lost: list[int] = []
        for start in range(0, self._count, _AT_ONCE):
            some = self._slots[start : start + _AT_ONCE]
            actor, critic = knots.actor[some], knots.critic[some]
            followed = follow(actor, critic, learning.actor_gain, self._bound, dt)
            if np.isfinite(followed.sum()):
                knots.actor[some] = followed
                continue
            sound = np.isfinite(actor).all(axis=(1, 2)) & np.isfinite(critic).all(axis=(1, 2))
            knots.actor[some[sound]] = followed[sound]
            lost += (start + np.flatnonzero(~sound)).tolist()
        if lost:
            self._problems.update(dict.fromkeys(lost, "weights are not finite"))
            knots.renew(self._followed)
            self._stop(np.isin(np.arange(self._count), lost))

    def settle(self, observation: Observation) -> bool:
        """Learn all that lies ahead of every robot; return whether the weights settled."""
        behind, ahead = self._span(observation)
        near = behind - self._window
        preview = math.ceil(observation.distance / self._knots.spacing) + self._window
        # All that is stored; round a lap, one preview more, which comes to lie under it.
        most = self._knots.capacity + (0 if self._knots.lap is None else self._window)
        far = np.minimum(ahead + preview, near + most)
        everyone = np.arange(self._count)
        for start, end, robots in self._together(everyone, near, far):
            slots = self._knots.slots(np.arange(start, end)[:, None], robots)
            group = Group(robots, Sweep(start, end, len(self._model), self._knots.end(end)))
            while not group.ended:
                self._work(group, len(self._model), math.inf)
            self._knots.actor[slots] = self._knots.critic[slots]
        self._stop(np.ones(self._count, bool))
        self._reach[:] = self._window
        return not self._problems

    def take_over(self, previous: "Learner") -> None:
        """Take over the weights of a learner of the same robots, path and problem."""
        if not isinstance(previous, PathLearner) or previous._count != self._count:
            return
        before, now = previous._riccati, self._riccati
        if before.path is not now.path or not before.profile.same_as(now.profile):
            return
        old, new = previous._settings, self._settings
        if (old.target, old.cost, old.limits) != (new.target, new.cost, new.limits):
            return
        if any(
            getattr(old.learning, name) != getattr(new.learning, name) for name in MODEL_SETTINGS
        ):
            return
        self._knots, self._reach = previous._knots, previous._reach

    def learned(self) -> LearnedWeights:
        """Return the first robot's weights at the knots where something was learned."""
        return self._knots.learned(int(self._reach[0]))

    def start_from(self, learned: LearnedWeights) -> str:
        """Start every robot from the weights of another run; return why not, empty if it did."""
        problem = self._knots.start_from(learned)
        if not problem:
            self._reach[:] = min(learned.reach, self._window)
            self._resting_at = b""
        return problem


Learner = PathLearner | PathStateLearner
