"""Stores critic and actor weights at knots along a path; between knots they are linear."""

import math
from collections.abc import Sequence

import numpy as np

from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray, Number, clamped
from adp_path_follower.core.learning.weights import LearnedWeights, Weights, initial_weights
from adp_path_follower.core.settings.groups import Settings

_MOST_KNOTS = 8192  # that are remembered: 5 MB for each of critic and actor
_FARTHEST = 1e12  # knots
_NODES = np.linspace(-0.5, 0.5, 5)  # of a knot's interval, for its mean curvature and speed
_SAME_LENGTH = 1e-4  # relative, and ...
_SAME_CURVATURE = 1e-3  # ... [1/m], and relative: a path that differs less is the same
_SAME_SPEED = 1e-3  # relative
_EMPTY = np.iinfo(np.int64).min  # the number in a slot that holds no knot


class KnotWeights:
    """Critic and actor weights of each of B robots at knots a distance h apart.

    Knots are numbered along the path. An open path goes on straight beyond its ends, for one
    preview. The knots of a closed path come round again if a lap fits into the memory; if not,
    every lap has its own. The last axis of knots and of arc lengths is that of the robots. Slots
    are numbered knot by knot, for all robots each, so memory is taken only for knots that some
    robot has been near.
    """

    def __init__(self, settings: Settings, riccati: RiccatiSchedule, robots: int) -> None:
        learning, path = settings.learning, riccati.path
        self._learning, self._path, self._riccati = learning, path, riccati
        count = max(1, math.ceil(path.length / learning.knot_spacing))
        self.spacing = path.length / count if path.closed else learning.knot_spacing  # h [m]
        preview = learning.preview_distance * settings.stretch
        self.window = max(2, round(preview / self.spacing))  # of a preview
        self._ends = None if path.closed else (-self.window, count + 1 + self.window)
        self.lap = count if path.closed and count <= _MOST_KNOTS else None  # as they come again
        self.size = len(learning.value_basis.labels)
        knots = count if path.closed else count + 2 + 2 * self.window
        self.capacity = min(_MOST_KNOTS, knots)  # for each robot
        self._robots = np.arange(robots)
        # The system provides this memory only where something is written.
        slots = self.capacity * robots
        self.critic, self.actor = np.zeros((slots, self.size)), np.zeros((slots, self.size))
        self.curvatures, self.speeds = np.zeros(slots), np.zeros(slots)  # at the knots of slots
        self.reset()

    def reset(self) -> None:
        """Return to the initial weights everywhere."""
        self._held = np.full(len(self.critic), _EMPTY)  # the knot that each slot holds
        self._pair = (0, (0, 0), (_EMPTY + 1, 0))  # see `_slots_about`

    def forget(self, robots: np.ndarray) -> None:
        """Return to the initial weights of the robots (B,) that are true."""
        self._held.reshape(self.capacity, len(self._robots))[:, robots] = _EMPTY

    def slots(self, knots: np.ndarray, robots: np.ndarray | None = None) -> np.ndarray:
        """Return where knots (..., n) of robots (n,), by default all, are stored, shape (..., n).

        New ones have initial weights. Knots (..., 1) are the same for all these robots.
        """
        number = self.number(knots)
        slots = self._places(number, robots)
        new = self._held[slots] != number
        if new.any():
            places, first = np.unique(slots[new], return_index=True)
            numbers = np.broadcast_to(number, slots.shape)[new][first]
            curvature, speed = self.about(numbers)
            weights = initial_weights(self._learning, self._riccati, curvature, speed)
            self.critic[places], self.actor[places] = weights.critic, weights.actor
            self.curvatures[places], self.speeds[places] = curvature, speed
            self._held[places] = numbers
        return np.asarray(slots)

    def number(self, knots: np.ndarray) -> np.ndarray:
        """Return the knots of any shape that stand for knots: round a lap, beyond an end."""
        if self.lap is not None:
            return np.asarray(knots % self.lap)
        if self._ends is not None:
            return np.asarray(np.minimum(np.maximum(knots, self._ends[0]), self._ends[1]))
        return knots

    def _places(self, number: np.ndarray, robots: np.ndarray | None = None) -> np.ndarray:
        """Return where there is room for knots, as `slots`."""
        robots = self._robots if robots is None else robots
        return np.asarray(number % self.capacity * len(self._robots) + robots)

    def renew(self, knots: np.ndarray) -> None:
        """Return to the initial weights at those of the knots (K,) whose are not finite."""
        slots = self.slots(knots)
        self._held[slots[~self._sound(self.critic[slots], self.actor[slots])]] = _EMPTY
        self.slots(knots)

    def position(self, arc_length: FloatArray) -> FloatArray:
        """Return arc lengths in knot spacings, same shape, within what integers can count."""
        if isinstance(arc_length, float):
            place = 0.0 if math.isnan(arc_length) else arc_length / self.spacing
            return np.float64(clamped(place, -_FARTHEST, _FARTHEST))
        place = np.where(np.isnan(arc_length), 0.0, arc_length) / self.spacing
        return np.minimum(np.maximum(place, -_FARTHEST), _FARTHEST)

    def local(self, arc_length: FloatArray) -> Weights:
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
        if not math.isfinite(float(np.vdot(actor, critic))):  # perhaps a weight is not
            sound = self._sound(critic, actor)[..., None]
            speed = self._riccati.profile.model_speed(arc_length)
            safe = self.safe(self._path.curvature(arc_length), speed)
            critic, actor = np.where(sound, critic, safe), np.where(sound, actor, safe)
            slope = np.where(sound, slope, 0.0)
        return Weights(critic, actor, slope)

    def _slots_about(self, knot: int) -> Sequence[int]:
        """Return the slots of a knot and of the next, most often those of the last call."""
        known, slots, numbers = self._pair
        if knot != known or any(
            self._held[slot] != number for slot, number in zip(slots, numbers, strict=True)
        ):
            first, second = self.slots(np.array([knot, knot + 1])).tolist()
            slots = (first, second)
            self._pair = (knot, slots, (int(self._held[first]), int(self._held[second])))
        return slots

    def about(self, knots: np.ndarray) -> tuple[FloatArray, FloatArray]:
        """Return mean curvature [1/m] and speed of models [m/s] about each knot, (K,) each."""
        arc_length = (knots[:, None] + _NODES) * self.spacing
        speed = np.broadcast_to(self._riccati.profile.model_speed(arc_length), arc_length.shape)
        return self._path.curvature(arc_length).mean(axis=1), speed.mean(axis=1)

    def safe(self, curvature: FloatArray, speed: Number) -> FloatArray:
        """Return the Riccati solution's weights at curvatures and speeds (...), shape (..., L)."""
        basis = self._learning.value_basis
        return basis.quadratic_weights(self._riccati.matrix(curvature, speed))

    def end(self, knot: int) -> FloatArray:
        """Return Wc ahead of a sweep from a knot: the Riccati solution, shape (L,)."""
        return np.asarray(self.safe(*self.about(np.array([knot])))[0])

    def learned(self, reach: int) -> LearnedWeights:
        """Return what the first robot, whose next sweep has that reach [knots], has learned."""
        slots = np.flatnonzero(self._held != _EMPTY)
        slots = slots[slots % len(self._robots) == 0]
        slots = slots[self._sound(self.critic[slots], self.actor[slots])]
        knots = self._held[slots]
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
        """Take the weights of a path of the same curvature; return why not, empty if it did."""
        path, knots = self._path, learned.knots
        if learned.closed != path.closed or not math.isclose(
            learned.length, path.length, rel_tol=_SAME_LENGTH
        ):
            kinds = {True: "a closed", False: "an open"}
            return (
                f"they were learned along {kinds[learned.closed]} path of {learned.length:.2f} m, "
                f"and this is {kinds[path.closed]} one of {path.length:.2f} m"
            )
        curvature, speed = self.about(knots)
        if not np.allclose(
            curvature, learned.curvature, rtol=_SAME_CURVATURE, atol=_SAME_CURVATURE
        ):
            return "they were learned along a path that bends elsewhere than this one"
        if not np.allclose(speed, learned.speed, rtol=_SAME_SPEED):
            return "they were learned at other speeds along the path than its profile has now"
        if len(np.unique(knots % self.capacity)) < len(knots):
            return "they hold more places of the path than are remembered"
        slots = self._places(learned.knots[:, None])
        self._held[slots] = learned.knots[:, None]
        self.curvatures[slots] = learned.curvature[:, None]
        self.speeds[slots] = learned.speed[:, None]
        self.critic[slots] = learned.critic[:, None]
        self.actor[slots] = learned.actor[:, None]
        return ""

    @staticmethod
    def _sound(critic: FloatArray, actor: FloatArray) -> np.ndarray:
        """Return which weights (..., L) are finite, shape (...)."""
        return np.asarray(np.isfinite(critic).all(axis=-1) & np.isfinite(actor).all(axis=-1))
