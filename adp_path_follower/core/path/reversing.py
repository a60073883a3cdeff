"""Driving backwards: the same problem for a robot that faces the other way.

A robot with heading theta and velocity v moves like one with heading theta + pi and velocity -v,
and the same angular velocity. That robot follows the path forwards; the functions here translate
between the two.
"""

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import update

_HALF_TURN: FloatArray = np.array([0.0, 0.0, np.pi])
_COMMAND_SIGNS: FloatArray = np.array([-1.0, 1.0])  # of v and w
_ERROR_SIGNS: FloatArray = np.array([-1.0, -1.0, 1.0])  # of s, y and theta


def turned_pose(pose: FloatArray) -> FloatArray:
    """Return poses [x, y, theta], shape (..., 3), with the opposite heading."""
    return pose + _HALF_TURN


def turned_command(command: FloatArray) -> FloatArray:
    """Return commands [v, w], shape (..., 2), as the robot that faces the other way needs them."""
    return command * _COMMAND_SIGNS


def turned_error(error: FloatArray) -> FloatArray:
    """Return errors [s, y, theta], shape (..., 3), seen by the robot that faces the other way."""
    return error * _ERROR_SIGNS


def turned_settings(settings: Settings) -> Settings:
    """Return the settings of the robot that faces the other way: limits are swapped, too."""
    fastest = -settings.limits.min_linear_vel
    return update(
        settings,
        {
            "min_linear_vel": -settings.limits.max_linear_vel,
            "max_linear_vel": fastest,
            "desired_speed": min(settings.target.desired_speed, fastest),
        },
    )
