"""What a robot has been told lately: its last command, and commands that are still under way."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from adp_path_follower.core.command_limits import limited_command
from adp_path_follower.core.geometry import FloatArray, components, unpacked
from adp_path_follower.core.settings import Settings

_LONGEST_DELAY = 1.0  # [s]: the highest actuation_delay; older commands are forgotten
_LEAST_PERIOD, _MOST_PERIOD = 1e-6, 0.1  # [s]: after a pause a command does not make up for it

_TURNED = np.array([-1.0, 1.0])  # of v and w


class Actuation:
    """Follows what is sent to one robot, or to a batch of robots; it outlives their followers.

    Attributes:
        command: The last command [v, w], shape (..., 2); zero after a stop.
        time: When it was sent [ns], None if that is not known.
        stopped: Whether the robot was told to stop, or nothing yet, since the last command.

    """

    def __init__(self) -> None:
        """Begin with a robot at rest."""
        self.time: int | None = None
        self.stop(forget=True)

    def stop(self, forget: bool = False) -> None:
        """Note that the robot was told to stop; forget what was under way if that is long ago."""
        self.stopped = True
        self.command: FloatArray = np.zeros(2)
        self._rate: FloatArray = np.zeros(2)
        if forget:
            self._clock = 0.0
            self._sent: deque[tuple[float, FloatArray]] = deque()
        else:
            self._sent.append((self._clock, self.command))

    def turn_round(self) -> None:
        """Tell the same to a robot that faces the other way: forwards is backwards."""
        self.command, self._rate = self.command * _TURNED, self._rate * _TURNED
        self._sent = deque((sent, command * _TURNED) for sent, command in self._sent)

    def predicted(self, pose: FloatArray, delay: float, elapsed: float) -> FloatArray:
        """Return where the commands under way lead a robot, shape (..., 3).

        Args:
            pose: Where it is now, shape (..., 3).
            delay: Time from a command to its effect [s].
            elapsed: Time since the last command was sent [s].

        """
        self._clock += elapsed
        while len(self._sent) > 1 and self._sent[1][0] <= self._clock - _LONGEST_DELAY:
            self._sent.popleft()
        if delay <= 0.0 or not self._sent:
            return pose
        # A command sent at t moves the robot from t + delay on: what was in force over the last
        # `delay` is what is to come.
        begin = self._clock - delay
        starts = np.maximum([sent for sent, _ in self._sent], begin)
        durations = np.diff(starts, append=self._clock)
        due = [index for index, held in enumerate(durations.tolist()) if held > 0.0]
        if not due:
            return pose
        commands = [np.broadcast_to(self._sent[index][1], (*pose.shape[:-1], 2)) for index in due]
        return _driven(pose, np.array(commands), durations[due])

    def limited(self, wanted: FloatArray, settings: Settings, elapsed: float) -> FloatArray:
        """Return the command that may follow the last one, shape (..., 2).

        Args:
            wanted: [v, w] within the limits of velocity, shape (..., 2).
            settings: Give the limits, and the period at a start.
            elapsed: Time since the last command was sent [s].

        """
        if not settings.motion.limited:
            return wanted
        period = self._period(settings, elapsed)
        return limited_command(
            wanted, self.command, self._rate, settings.limits, settings.motion, period
        )

    def send(self, command: FloatArray, settings: Settings, elapsed: float) -> None:
        """Note a command [v, w], shape (..., 2), `elapsed` [s] after the last one."""
        self._rate = (command - self.command) / self._period(settings, elapsed)
        self.command = command
        self.stopped = False
        self._sent.append((self._clock, command))

    def _period(self, settings: Settings, elapsed: float) -> float:
        """Return the time over which a command may change [s]; after a stop, a usual period."""
        if self.stopped or elapsed <= _LEAST_PERIOD:
            return 1.0 / settings.controller.controller_frequency
        return min(elapsed, _MOST_PERIOD)


def _driven(pose: FloatArray, commands: FloatArray, durations: FloatArray) -> FloatArray:
    """Return the pose after commands (N, ..., 2) were held for durations (N,) [s], (..., 3).

    Exact, as N times `geometry.advance_pose`: arcs, each with its chord.
    """
    held = durations.reshape(-1, *[1] * (commands.ndim - 2))
    distance, turn = commands[..., 0] * held, commands[..., 1] * held
    x, y, theta = unpacked(pose)
    middle = theta + np.cumsum(turn, axis=0) - 0.5 * turn
    chord = distance * np.sinc(0.5 * turn / math.pi)
    return components(
        np.asarray(x + (chord * np.cos(middle)).sum(axis=0)),
        np.asarray(y + (chord * np.sin(middle)).sum(axis=0)),
        np.asarray(theta + turn.sum(axis=0)),
    )
