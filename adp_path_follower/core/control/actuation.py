"""The recent commands of a robot: the last one, and those that have not taken effect yet."""

import math
from collections import deque

import numpy as np

from adp_path_follower.core.geometry import FloatArray, components, unpacked
from adp_path_follower.core.path.route import turned_command
from adp_path_follower.core.settings.groups import LimitSettings, MotionSettings, Settings

_LONGEST_DELAY = 1.0  # [s]: the highest actuation_delay; older commands are forgotten
_LEAST_PERIOD, _MOST_PERIOD = 1e-6, 0.1  # [s]: after a pause a command does not make up for it


class Actuation:
    """Follows what is sent to one robot, or to a batch of robots; it outlives their followers.

    A control step asks in this order: `advance` lets time pass, `predicted` gives the pose to
    control from, `limited` the command that may follow, and `send` notes it.
    """

    def __init__(self) -> None:
        self.time: int | None = None  # of the last command [ns], if known
        self._elapsed = 0.0  # [s] from the last command to the next
        self.stop(forget=True)

    def stop(self, forget: bool = False) -> None:
        """Note a stop of the robot; forget earlier commands if that is long ago."""
        self.stopped = True  # since the last command, or from the beginning
        self.command: FloatArray = np.zeros(2)  # the last [v, w], (..., 2)
        self._rate: FloatArray = np.zeros(2)
        if forget:
            self._clock = 0.0
            self._sent: deque[tuple[float, FloatArray]] = deque()
        else:
            self._sent.append((self._clock, self.command))

    def turn_round(self) -> None:
        """Go on with a robot that faces the other way: forwards is backwards."""
        self.command, self._rate = turned_command(self.command), turned_command(self._rate)
        self._sent = deque((sent, turned_command(command)) for sent, command in self._sent)

    def advance(self, elapsed: float) -> None:
        """Let time pass until the next command, `elapsed` [s] after the last one."""
        self._elapsed = elapsed
        self._clock += elapsed
        while len(self._sent) > 1 and self._sent[1][0] <= self._clock - _LONGEST_DELAY:
            self._sent.popleft()

    def predicted(self, pose: FloatArray, delay: float) -> FloatArray:
        """Return poses (..., 3) after the commands that take effect within a delay [s]."""
        if delay <= 0.0 or not self._sent:
            return pose
        # A command sent at t moves the robot from t + delay on, so the commands of the last `delay`
        # are still to come.
        begin = self._clock - delay
        starts = np.maximum([sent for sent, _ in self._sent], begin)
        durations = np.diff(starts, append=self._clock)
        due = [index for index, held in enumerate(durations.tolist()) if held > 0.0]
        if not due:
            return pose
        commands = [np.broadcast_to(self._sent[index][1], (*pose.shape[:-1], 2)) for index in due]
        return _driven(pose, np.array(commands), durations[due])

    def limited(self, wanted: FloatArray, settings: Settings) -> FloatArray:
        """Return the command nearest to a wanted one that may follow the last one, (..., 2)."""
        if not settings.motion.limited:
            return wanted
        limits, motion, period = settings.limits, settings.motion, self._period(settings)
        return limited_command(wanted, self.command, self._rate, limits, motion, period)

    def send(self, command: FloatArray, settings: Settings) -> None:
        """Note that a command [v, w], shape (..., 2), is sent now."""
        self._rate = (command - self.command) / self._period(settings)
        self.command = command
        self.stopped = False
        self._sent.append((self._clock, command))

    def _period(self, settings: Settings) -> float:
        """Return the time over which a command may change [s]; after a stop, a usual period."""
        if self.stopped or self._elapsed <= _LEAST_PERIOD:
            return 1.0 / settings.controller.controller_frequency
        return min(self._elapsed, _MOST_PERIOD)


def _driven(pose: FloatArray, commands: FloatArray, durations: FloatArray) -> FloatArray:
    """Return the exact poses (..., 3) after commands (N, ..., 2) held for durations (N,) [s]."""
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


def limited_command(
    wanted: FloatArray,
    previous: FloatArray,
    rate: FloatArray,
    limits: LimitSettings,
    motion: MotionSettings,
    dt: float,
) -> FloatArray:
    """Return the command nearest to the wanted one that can follow the previous one, (..., 2).

    Limits of acceleration always hold, those of velocity unless the previous command is beyond
    them; then it returns to them as fast as accelerations allow. A limit of jerk gives way to both.
    `wanted` is within the limits of velocity; `rate` is the change of `previous` [m/s², rad/s²],
    (..., 2) each; dt > 0 is the time since the last command [s].
    """
    lower, upper = _within_reach(previous, motion, dt)
    if motion.jerk_limited:
        jerk = np.array([motion.max_linear_jerk, motion.max_angular_jerk])
        beyond = (previous < limits.lower) | (previous > limits.upper)
        wanted = np.where(beyond, wanted, _smoothed(wanted, previous, rate, jerk, dt))
        lower = np.maximum(lower, np.minimum(limits.lower, previous))
        upper = np.minimum(upper, np.maximum(limits.upper, previous))
    return np.asarray(np.minimum(np.maximum(wanted, lower), upper))


def _within_reach(
    previous: FloatArray, motion: MotionSettings, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Return the least and greatest [v, w] that accelerations allow; v changes sign by zero."""
    v, w = unpacked(previous)
    rise, fall = motion.max_linear_accel * dt, motion.max_linear_decel * dt
    turn = motion.max_angular_accel * dt
    least = np.where(v > 0.0, np.maximum(v - fall, 0.0), v - rise)
    greatest = np.where(v < 0.0, np.minimum(v + fall, 0.0), v + rise)
    return components(least, w - turn), components(greatest, w + turn)


def _smoothed(
    wanted: FloatArray, previous: FloatArray, rate: FloatArray, jerk: FloatArray, dt: float
) -> FloatArray:
    """Return the command after limits of jerk (2,), shape (..., 2).

    The rate of change r stays below what jerk j can take back to zero before the wanted command is
    reached: r, r - j dt, r - 2 j dt, ... sum up to r² / 2j + r dt / 2, and at most j dt² / 8 more
    because the last of them is not zero.
    """
    change = wanted - previous
    limited = np.isfinite(jerk)
    jerk = np.where(limited, jerk, 1.0)
    half = 0.5 * jerk * dt
    highest = np.sqrt(half * half + 2.0 * jerk * np.abs(change)) - half
    reached = np.minimum(np.maximum(change / dt, -highest), highest)
    reached = np.minimum(np.maximum(reached, rate - jerk * dt), rate + jerk * dt)
    return np.asarray(np.where(limited, previous + reached * dt, wanted))
