"""Checks whether a robot that follows a path gets anywhere."""

import math

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.navigation import NavigationSettings


class ProgressCheck:
    """Remembers where the robot was last seen to have made progress."""

    def __init__(self) -> None:
        self._place: tuple[float, float] | None = None
        self._since = 0.0

    def problem(self, now: float, pose: FloatArray | None, settings: NavigationSettings) -> str:
        """Return how a robot at a pose (3,) and a time [s] lacks progress, empty if it does not.

        Without a pose the robot is not to drive, and has all the time anew.
        """
        if pose is None:
            self._place = None
            return ""
        place = float(pose[0]), float(pose[1])
        radius, allowance = settings.required_movement_radius, settings.movement_time_allowance
        if self._place is None or math.dist(place, self._place) >= radius or now < self._since:
            self._place, self._since = place, now
        if now - self._since <= allowance:
            return ""
        return f"the robot moved less than {radius:g} m in {allowance:g} s"
