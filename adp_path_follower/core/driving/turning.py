"""Turns on the spot: a robot at rest turns to a heading, within its limits."""

import math

import numpy as np

from adp_path_follower.core.control.actuation import Actuation
from adp_path_follower.core.geometry import FloatArray, wrap_angle
from adp_path_follower.core.path.speed_profile import SHARE
from adp_path_follower.core.settings.groups import Settings

_RATE = 2.0  # [1/s] of the heading error that is left
_DONE = 0.5  # share of yaw_goal_tolerance within which a turn ends, and ...
_SLOW = 0.15  # [rad/s] ... the angular velocity below which it does


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
    if done and abs(float(actuation.command[1])) <= _SLOW:
        return None
    braking = math.sqrt(2.0 * SHARE * motion.max_angular_accel * abs(left))
    speed = min(_RATE * abs(left), braking, limits.max_angular_vel)
    wanted = np.array([0.0, math.copysign(speed, left)])
    command = actuation.limited(wanted, settings)
    actuation.send(command, settings)
    return command
