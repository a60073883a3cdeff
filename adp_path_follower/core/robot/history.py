"""The commands that a robot was sent lately."""

import math
from bisect import bisect_right

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.model import Held

_MEMORY = 2.5  # [s]
_FINE = 0.01  # [s] of a ramp in one piece
_MOST = 512  # commands, above which those older than the memory are forgotten

# A command, and the velocities set until then.
_Sent = tuple[tuple[float, float], tuple[float, float]]


class CommandHistory:
    """Remembers commands [m/s, rad/s] and their times; before the first, the robot rests."""

    def __init__(self) -> None:
        self.last = (0.0, 0.0)
        self.ramps = (math.inf, math.inf)  # of v and w, by the firmware [m/s^2, rad/s^2]
        self._times: list[float] = []
        self._sent: list[_Sent] = []

    def send(self, time: float, command: tuple[float, float]) -> None:
        """Note a command that is sent at a time [s], no earlier than the last one."""
        reached = (0.0, 0.0)
        if self._times:
            reached = self._reached(len(self._times) - 1, time)
        self.last = command
        self._times.append(time)
        self._sent.append((command, reached))
        if len(self._times) > _MOST:
            old = bisect_right(self._times, time - _MEMORY) - 1
            if old > 0:
                del self._times[:old], self._sent[:old]

    def reached(self, time: float) -> FloatArray:
        """Return the velocities set by the last command at a time [s], (2,)."""
        return np.array(self._reached(len(self._times) - 1, time) if self._times else (0.0, 0.0))

    def held(self, start: float, end: float) -> list[Held]:
        """Return what acts of the commands sent between two times [s], and for how long each."""
        index = bisect_right(self._times, start) - 1
        found: list[Held] = []
        if index < 0 and start < end:
            first = min(self._times[0], end) if self._times else end
            found.append((0.0, 0.0, first - start))
            start, index = first, 0
        while start < end and index < len(self._times):
            following = self._times[index + 1] if index + 1 < len(self._times) else end
            stop = min(following, end)
            if stop > start:
                self._act(found, index, start, stop)
                start = stop
            index += 1
        return found

    def ahead(self, now: float, duration: float) -> list[Held]:
        """Return how the last command would go on acting for a duration [s] from a time [s] on."""
        if not self._times:
            return [(0.0, 0.0, duration)]
        found: list[Held] = []
        self._act(found, len(self._times) - 1, now, now + duration)
        return found

    def _act(self, found: list[Held], index: int, start: float, stop: float) -> None:
        """Add the pieces of one command from one time to another."""
        command, before = self._sent[index][0], self._reached(index, start)
        while start < stop and before != command:
            until = min(stop, start + _FINE)
            after = self._reached(index, until)
            v, w = 0.5 * (before[0] + after[0]), 0.5 * (before[1] + after[1])
            found.append((v, w, until - start))
            start, before = until, after
        if start < stop:
            found.append((*command, stop - start))

    def _reached(self, index: int, time: float) -> tuple[float, float]:
        """Return the velocities that one command has set at a time [s]."""
        (v, w), (from_v, from_w) = self._sent[index]
        elapsed, (ramp, angular_ramp) = time - self._times[index], self.ramps
        return _ramped(v, from_v, elapsed, ramp), _ramped(w, from_w, elapsed, angular_ramp)


def _ramped(wanted: float, before: float, elapsed: float, ramp: float) -> float:
    """Return the velocity that is set some time [s] after a command was sent."""
    if ramp == math.inf:
        return wanted
    most = ramp * elapsed if elapsed > 0.0 else 0.0
    return before + min(max(wanted - before, -most), most)
