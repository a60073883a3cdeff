"""Whether a robot that was told to stop has come to rest, by its poses."""

from __future__ import annotations

import math
from collections import deque

from adp_path_follower.core.geometry import FloatArray

_WINDOW = 200_000_000  # [ns] over which a robot at rest hardly moves
_DISTANCE, _TURN = 0.005, 0.01  # [m], [rad] that it may, by its odometry's noise
_LONGEST = 2_000_000_000  # [ns] to wait for a robot whose odometry never rests


class Standstill:
    """Waits for a robot to stand still."""

    def __init__(self) -> None:
        """Begin to wait."""
        self._seen: deque[tuple[int, float, float, float]] = deque()
        self._since: int | None = None

    def reached(self, pose: FloatArray, time: int) -> bool:
        """Return whether the robot rests, from its pose (3,) at a time [ns]."""
        if self._since is None or time < self._seen[-1][0]:  # or a clock that has gone back
            self._since = time
            self._seen.clear()
        x, y, theta = pose.tolist()
        self._seen.append((time, x, y, theta))
        while time - self._seen[0][0] > _WINDOW and time - self._seen[1][0] >= _WINDOW:
            self._seen.popleft()
        if time - self._since >= _LONGEST:
            return True
        return time - self._seen[0][0] >= _WINDOW and all(
            math.hypot(x - old_x, y - old_y) < _DISTANCE
            and abs(math.remainder(theta - old_theta, math.tau)) < _TURN
            for _, old_x, old_y, old_theta in self._seen
        )
