"""Driving backwards: the same problem for a robot that faces the other way.

A robot with heading theta and velocity v moves like one with heading theta + pi and velocity -v,
and the same angular velocity. That robot follows the path forwards; what it is told, and how it is
off, is put in the real robot's terms here.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from adp_path_follower.core.driving.command_law import FollowerOutput
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import update

_SIGNS = np.array([-1.0, 1.0])  # of v and w
_ERROR_SIGNS = np.array([-1.0, -1.0, 1.0])  # of s, y and theta
_HALF_TURN = np.array([0.0, 0.0, np.pi])


def reversed_settings(settings: Settings) -> Settings:
    """Return the settings of the robot that faces the other way.

    Its highest velocity is the real one's lowest with the sign changed, and the other way round;
    it follows the path no faster than that.
    """
    fastest = -settings.limits.min_linear_vel
    return update(
        settings,
        {
            "min_linear_vel": -settings.limits.max_linear_vel,
            "max_linear_vel": fastest,
            "desired_speed": min(settings.target.desired_speed, fastest),
        },
    )


def reversed_output(output: FollowerOutput) -> FollowerOutput:
    """Return an output of the robot that faces the other way in the real robot's terms.

    The target pose has the heading that the robot should have; the error is that of the robot to
    it. Curvature is seen from there: positive to the robot's left.
    """
    return replace(
        output,
        command=output.command * _SIGNS,
        modified_input=output.modified_input * _SIGNS,
        error=output.error * _ERROR_SIGNS,
        target_pose=output.target_pose + _HALF_TURN,
        curvature=-output.curvature,
    )
