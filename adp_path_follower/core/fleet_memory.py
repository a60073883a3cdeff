"""The weights at the knots of a path for many robots, each with weights of its own."""

from __future__ import annotations

import numpy as np

from adp_path_follower.core.knot_memory import NOBODY, KnotMemory
from adp_path_follower.core.path import Path
from adp_path_follower.core.riccati import RiccatiSchedule
from adp_path_follower.core.settings import Settings
from adp_path_follower.core.speed_profile import SpeedProfile


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
