"""Learns knot by knot, backwards along the path: from the Riccati solution at the end of a preview.

The weights of knot k have the least Bellman errors for the policy of knot k + 1, which is ahead of
it. With least squares they depend on nothing else, so robots near one another share a sweep.
"""

from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.knot_critic import CriticUpdate, KnotCritic
from adp_path_follower.core.learning.knot_model import KnotModel, NormalEquations


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

    def next_knot(self) -> None:
        """Turn to the next knot."""
        self.index += 1
        self.slots, self.done, self.time = None, 0, 0.0

    def keep(self, chosen: np.ndarray) -> None:
        """Let only the robots (n,) that are true stay in the group."""
        self.robots = self.robots[chosen]
        self.slots = None if self.slots is None else self.slots[chosen]

    @property
    def ended(self) -> bool:
        """Return whether all knots are passed."""
        return self.index == self.sweep.far - self.sweep.near
