"""Decides whether a robot has come to the end of its path or stands beside it; turns it."""

import math
from collections import deque

import numpy as np

from adp_path_follower.core.control.actuation import Actuation
from adp_path_follower.core.driving.output import ControlOutput
from adp_path_follower.core.geometry import FloatArray, tracking_error, wrap_angle
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.speed_profile import SHARE
from adp_path_follower.core.settings.groups import MotionSettings, Settings

_RATE = 2.0  # [1/s] of the heading error that is left
_PART = 0.5 * math.pi  # between two headings on the way
_DONE = 0.5  # share of yaw_goal_tolerance within which a turn ends, and ...
_SLOW = np.array([0.001, 0.15])  # [m/s, rad/s] ... the command below which it does


class Turn:
    """A turn on the spot, perhaps more than once round, by way of headings in between."""

    def __init__(self, heading: float, turn: float, pose: FloatArray) -> None:
        """Turn by an angle to a heading [rad].

        The shorter way from each heading to the next is the turn's. A robot with a pose (3,) goes
        on from the first of them that is near, and from elsewhere straight to the last.
        """
        parts = max(1, math.ceil(abs(turn) / _PART - 1e-9))
        headings = [heading - turn * (1.0 - part / parts) for part in range(parts + 1)]
        near = (place for place, here in enumerate(headings) if _is_near(here, pose))
        self._left = headings[next(near, parts) + 1 :] or [heading]

    def command(
        self, pose: FloatArray, time: int, actuation: Actuation, settings: Settings
    ) -> FloatArray | None:
        """Return the command of `turning_command`, None at the end of the turn."""
        while len(self._left) > 1 and _is_near(self._left[0], pose):
            del self._left[0]  # without a stop
        return turning_command(self._left[0], pose, time, actuation, settings)


def _is_near(heading: float, pose: FloatArray) -> bool:
    return abs(math.remainder(heading - float(pose[2]), math.tau)) <= 0.51 * _PART


def turning_command(
    heading: float, pose: FloatArray, time: int, actuation: Actuation, settings: Settings
) -> FloatArray | None:
    """Return [v, w] that turns a robot at rest to a heading [rad], None when it has it.

    It turns the shorter way round. The pose is x, y, theta (3,), the time [ns] that of the command,
    which is added to those of `actuation`.
    """
    motion, limits = settings.motion, settings.limits
    elapsed = 0.0 if actuation.time is None else 1e-9 * (time - actuation.time)
    actuation.time = time
    if not 0.0 < elapsed <= settings.controller.odom_timeout:
        actuation.stop(forget=True)
    actuation.advance(max(elapsed, 0.0))
    left = float(wrap_angle(heading - actuation.predicted(pose, motion.actuation_delay)[2]))
    done = abs(left) <= _DONE * motion.yaw_goal_tolerance
    if done and (np.abs(actuation.command) <= _SLOW).all():
        return None
    braking = math.sqrt(2.0 * SHARE * motion.max_angular_accel * abs(left))
    speed = min(_RATE * abs(left), braking, limits.max_angular_vel)
    wanted = np.array([0.0, math.copysign(speed, left)])
    command = actuation.limited(wanted, settings)
    actuation.send(command, settings)
    return command


_STANDING = np.array([0.02, 0.1])  # [m/s, rad/s]: commands below bring nothing more
_PATIENCE = 10.0  # [s] from the target's arrival until a robot that is not there is given up


class Goal:
    """The end of an open path; a closed one has none."""

    def __init__(self, path: Path, motion: MotionSettings, stops: bool) -> None:
        self.reached: np.ndarray = np.zeros((), dtype=bool)  # shape (...)
        self.problem = ""  # why one robot will not get there
        self._open, self._length = not path.closed, path.length
        self._pose = path.frame(path.length).pose
        self._motion, self._stops = motion, stops
        self._waited = 0.0

    def look(self, pose: FloatArray, output: ControlOutput, dt: float) -> None:
        """Note poses (..., 3) and commands of robots, dt [s] after the last."""
        if not self._open:
            return
        tolerance = self._motion.xy_goal_tolerance
        arrived = output.arc_length >= self._length - (tolerance if self._stops else 0.0)
        if not arrived.any():
            self.reached, self._waited = arrived, 0.0
            return
        error = tracking_error(pose, self._pose)
        distance, turn = np.hypot(error[..., 0], error[..., 1]), np.abs(error[..., 2])
        near = (distance <= tolerance) & (turn <= self._motion.yaw_goal_tolerance)
        if self._stops:
            standing = (np.abs(output.command) <= _STANDING).all(axis=-1)
            self.reached = arrived & near & standing
        else:  # it drives on, so where it has been counts
            self.reached = self.reached | (arrived & near)
        self._waited += dt
        if self.reached.ndim == 0 and not near and not self.reached:
            passed = not self._stops and error[0] > tolerance
            if passed or self._waited > _PATIENCE:
                self.problem = self._miss(float(distance), float(turn))

    def _miss(self, distance: float, turn: float) -> str:
        """Return how far [m, rad] a robot is from the end that it will not come nearer to."""
        remedy = "" if self._stops else "; with a finite max_linear_decel it brakes to the end"
        return (
            f"the robot is {distance:.3f} m and {turn:.3f} rad from the end of the path, "
            f"beyond xy_goal_tolerance {self._motion.xy_goal_tolerance:g} or "
            f"yaw_goal_tolerance {self._motion.yaw_goal_tolerance:g}{remedy}"
        )


_WINDOW = 200_000_000  # [ns] over which a robot at rest hardly moves
_DISTANCE, _TURN = 0.005, 0.01  # [m], [rad] that it may, by its odometry's noise
_LONGEST = 2_000_000_000  # [ns] to wait for a robot whose odometry never rests


class Standstill:
    """Waits for a robot to stand still."""

    def __init__(self) -> None:
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
