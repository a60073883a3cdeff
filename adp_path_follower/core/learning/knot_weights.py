"""The weights at the knots of a path, as far as they are remembered."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray, Number, clamped
from adp_path_follower.core.learning.learner import initial_weights
from adp_path_follower.core.learning.update_laws import surely_finite
from adp_path_follower.core.learning.weights import LearnedWeights, LocalWeights, Weights
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings

_MOST_KNOTS = 8192  # that are remembered: 5 MB for each of critic and actor
_FARTHEST = 1e12  # knots
_NODES = np.linspace(-0.5, 0.5, 5)  # of a knot's interval, for its mean curvature and speed
_SAME_LENGTH = 1e-4  # relative, and ...
_SAME_CURVATURE = 1e-3  # ... [1/m], and relative: a path that differs less is the same
_SAME_SPEED = 1e-3  # relative
NOBODY = np.iinfo(np.int64).min  # who owns a slot that holds no knot


class KnotMemory:
    """Critic and actor weights at knots a distance h apart, numbered along the path.

    Of an open path that goes on straight beyond its ends, for one preview; the knots of a closed
    one that fits into the memory come round again, of a longer one every lap has its own.

    Attributes:
        spacing: h [m].
        window: Number of knots of the preview.
        lap: Number of knots of a lap, if they come round again, else None.
        size: Number of weights L.
        critic: Critic weights by slot, shape (slots, L).
        actor: Actor weights likewise.
        curvatures: kappa [1/m] at each slot's knot.
        speeds: v_des [m/s] there, as models take it.

    """

    def __init__(
        self, settings: Settings, path: Path, riccati: RiccatiSchedule, profile: SpeedProfile
    ) -> None:
        """Lay the knots along a path."""
        learning = settings.learning
        self._learning, self._path, self._riccati = learning, path, riccati
        self._profile = profile
        count = max(1, math.ceil(path.length / learning.knot_spacing))
        self.spacing = path.length / count if path.closed else learning.knot_spacing
        self.window = max(2, round(learning.preview_distance / self.spacing))
        self._ends = None if path.closed else (-self.window, count + 1 + self.window)
        self.lap = count if path.closed and count <= _MOST_KNOTS else None
        self.size = len(learning.value_basis.labels)
        knots = count if path.closed else count + 2 + 2 * self.window
        self._capacity = min(_MOST_KNOTS, knots)
        self._lay_out(self._capacity)

    def _lay_out(self, count: int) -> None:
        """Make room for so many knots; the system gives it where there is something to keep."""
        self.critic = np.zeros((count, self.size))
        self.actor = np.zeros((count, self.size))
        self.curvatures = np.zeros(count)
        self.speeds = np.zeros(count)
        self.reset()

    def reset(self) -> None:
        """Return to the initial weights everywhere."""
        self._owner = np.full(len(self.critic), NOBODY)  # the knot that each slot holds
        self._pair = (0, (0, 0), (NOBODY + 1, 0))  # see `_slots_about`

    def slots(self, knots: np.ndarray) -> np.ndarray:
        """Return where knots of any shape are stored, with initial weights if they are new."""
        number = self.number(knots)
        slots = self._places(number)
        new = self._owner[slots] != number
        if new.any():
            places, first = np.unique(slots[new], return_index=True)
            numbers = number[new][first]
            curvature, speed = self.curvature(numbers), self.speed(numbers)
            weights = initial_weights(self._learning, self._riccati, curvature, speed)
            self.critic[places], self.actor[places] = weights.critic, weights.actor
            self.curvatures[places], self.speeds[places] = curvature, speed
            self._owner[places] = numbers
        return np.asarray(slots)

    def number(self, knots: np.ndarray) -> np.ndarray:
        """Return the knots of any shape that stand for knots: round a lap, beyond an end."""
        if self.lap is not None:
            return np.asarray(knots % self.lap)
        if self._ends is not None:
            return np.asarray(np.minimum(np.maximum(knots, self._ends[0]), self._ends[1]))
        return knots

    def _places(self, number: np.ndarray) -> np.ndarray:
        """Return where there is room for knots of any shape."""
        return np.asarray(number % self._capacity)

    def known_slots(self) -> np.ndarray:
        """Return the slots that hold a knot, shape (K,)."""
        return np.flatnonzero(self._owner != NOBODY)

    def renew(self, knots: np.ndarray) -> None:
        """Return to the initial weights at those of the knots (K,) whose are not finite."""
        slots = self.slots(knots)
        self._owner[slots[~self._sound(self.critic[slots], self.actor[slots])]] = NOBODY
        self.slots(knots)

    def position(self, arc_length: FloatArray) -> FloatArray:
        """Return arc lengths in knot spacings, same shape, within what integers can count."""
        if isinstance(arc_length, float):
            place = 0.0 if math.isnan(arc_length) else arc_length / self.spacing
            return np.float64(clamped(place, -_FARTHEST, _FARTHEST))
        place = np.where(np.isnan(arc_length), 0.0, arc_length)[()] / self.spacing
        return np.minimum(np.maximum(place, -_FARTHEST), _FARTHEST)

    def local(self, arc_length: FloatArray) -> LocalWeights:
        """Return the weights at arc lengths [m] of any shape, and their slope along the path."""
        position = self.position(arc_length)
        if isinstance(position, float):
            knot = math.floor(position)
            share, slots = position - knot, self._slots_about(knot)
        else:
            behind = np.floor(position)
            share = (position - behind)[..., None]
            slots = self.slots(np.add.outer((0, 1), behind.astype(np.int64)))
        (critic, critic_ahead), (actor, actor_ahead) = (
            (weights[slots[0]], weights[slots[1]]) for weights in (self.critic, self.actor)
        )
        critic_step = critic_ahead - critic
        actor = actor + share * (actor_ahead - actor)
        critic = critic + share * critic_step
        slope = critic_step / self.spacing
        if not surely_finite(actor, critic):
            sound = self._sound(critic, actor)[..., None]
            speed = self._profile.model_speed(arc_length)
            safe = self.safe(self._path.curvature(arc_length), speed)
            critic, actor = np.where(sound, critic, safe), np.where(sound, actor, safe)
            slope = np.where(sound, slope, 0.0)
        return LocalWeights(Weights(critic, actor), slope)

    def _slots_about(self, knot: int) -> Sequence[int]:
        """Return the slots of a knot and of the next, most often those of the last call."""
        known, slots, owners = self._pair
        if knot != known or any(
            self._owner[slot] != owner for slot, owner in zip(slots, owners, strict=True)
        ):
            first, second = self.slots(np.array([knot, knot + 1])).tolist()
            slots = (first, second)
            self._pair = (knot, slots, (int(self._owner[first]), int(self._owner[second])))
        return slots

    def curvature(self, knots: np.ndarray) -> FloatArray:
        """Return the mean curvature [1/m] about each knot, shape (K,)."""
        arc_length = (knots[:, None] + _NODES) * self.spacing
        return np.asarray(self._path.curvature(arc_length).mean(axis=1))

    def speed(self, knots: np.ndarray) -> FloatArray:
        """Return the mean speed [m/s] about each knot, as models take it, shape (K,)."""
        arc_length = (knots[:, None] + _NODES) * self.spacing
        speed = np.broadcast_to(self._profile.model_speed(arc_length), arc_length.shape)
        return np.asarray(speed.mean(axis=1))

    def safe(self, curvature: FloatArray, speed: Number) -> FloatArray:
        """Return the Riccati solution's weights at curvatures and speeds (...), shape (..., L)."""
        basis = self._learning.value_basis
        return basis.quadratic_weights(self._riccati.matrix(curvature, speed))

    def ends(self, knots: np.ndarray) -> FloatArray:
        """Return what is ahead of sweeps from knots (K,), the Riccati solution, shape (K, L)."""
        return self.safe(self.curvature(knots), self.speed(knots))

    def learned(self, reach: int) -> LearnedWeights:
        """Return the weights at the knots where something was learned; reach is a sweep's."""
        slots = self.known_slots()
        slots = slots[self._sound(self.critic[slots], self.actor[slots])]
        knots = self._owner[slots]
        if self._path.closed:  # every lap begins anew
            knots = knots % max(1, round(self._path.length / self.spacing))
        order = np.argsort(knots)
        slots = slots[order]
        return LearnedWeights(
            length=self._path.length,
            closed=self._path.closed,
            reach=reach,
            knots=knots[order],
            curvature=self.curvatures[slots],
            speed=self.speeds[slots],
            critic=self.critic[slots],
            actor=self.actor[slots],
        )

    def start_from(self, learned: LearnedWeights) -> str:
        """Take the weights of a run on a path of the same curvature, wherever it lay.

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
            self.curvature(knots), learned.curvature, rtol=_SAME_CURVATURE, atol=_SAME_CURVATURE
        ):
            return "they were learned along a path that bends elsewhere than this one"
        if not np.allclose(self.speed(knots), learned.speed, rtol=_SAME_SPEED):
            return "they were learned at other speeds along the path than its profile has now"
        if len(np.unique(knots % self._capacity)) < len(knots):
            return "they hold more places of the path than are remembered"
        self.take(learned)
        return ""

    def take(self, learned: LearnedWeights) -> None:
        """Take the weights of a run on the same path."""
        slots = self._places(learned.knots[:, None])
        self._owner[slots] = learned.knots[:, None]
        self.curvatures[slots] = learned.curvature[:, None]
        self.speeds[slots] = learned.speed[:, None]
        self.critic[slots] = learned.critic[:, None]
        self.actor[slots] = learned.actor[:, None]

    @staticmethod
    def _sound(critic: FloatArray, actor: FloatArray) -> np.ndarray:
        """Return which weights (..., L) are finite, shape (...)."""
        return np.asarray(np.isfinite(critic).all(axis=-1) & np.isfinite(actor).all(axis=-1))


class FleetMemory(KnotMemory):
    """What a `KnotMemory` is to one robot, to each of B robots.

    The last axis of knots and of arc lengths is that of the robots. Slots are numbered knot by
    knot, for all robots each: so memory is taken only for knots that some robot has been near.
    """

    def __init__(
        self,
        settings: Settings,
        path: Path,
        riccati: RiccatiSchedule,
        profile: SpeedProfile,
        robots: int,
    ) -> None:
        """Lay the knots along a path, for so many robots."""
        self._robots = robots
        super().__init__(settings, path, riccati, profile)

    def _lay_out(self, count: int) -> None:
        """Make room for so many knots of each robot."""
        self._numbers = np.arange(self._robots)
        super()._lay_out(count * self._robots)

    def _places(self, number: np.ndarray) -> np.ndarray:
        """Return where there is room for knots (..., B), or for those of all robots (..., 1)."""
        return np.asarray(super()._places(number) * self._robots + self._numbers)

    def known_slots(self) -> np.ndarray:
        """Return the slots in which the first robot has a knot, shape (K,)."""
        slots = super().known_slots()
        return np.asarray(slots[slots % self._robots == 0])

    def forget_robots(self, robots: np.ndarray) -> None:
        """Return to the initial weights of the robots (B,) that are true."""
        self._owner.reshape(self._capacity, self._robots)[:, robots] = NOBODY

    def copy_from(self, alone: KnotMemory, robots: np.ndarray) -> None:
        """Take over what is in the memory of a single robot, for robots with indices (n,)."""
        known = alone.known_slots()
        slots = known[:, None] * self._robots + robots
        self._owner[slots] = alone._owner[known, None]
        self.curvatures[slots] = alone.curvatures[known, None]
        self.speeds[slots] = alone.speeds[known, None]
        self.critic[slots] = alone.critic[known, None]
        self.actor[slots] = alone.actor[known, None]
