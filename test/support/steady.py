"""Speeds along a path that are the same everywhere, whatever its curvature."""

import math

from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.control.virtual_target import VirtualTarget
from adp_path_follower.core.path.speed_profile import SpeedProfile, SpeedReference
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

_UNLIMITED = {"max_linear_vel": math.inf, "max_angular_vel": math.inf}


def steady_reference(path, target):
    """Return the speed of a target's settings, everywhere on a path."""
    tuning = build(Settings, {**_UNLIMITED, "desired_speed": target.desired_speed})
    return SpeedReference(SpeedProfile(path, tuning), tuning)


def steady_target(path, target, arc_length):
    """Return a virtual target at arc lengths [m] of a path, with that speed."""
    return VirtualTarget(path, target, arc_length, steady_reference(path, target))


def steady_schedule(path, target, cost):
    """Return the Riccati solutions along a path for that speed."""
    return RiccatiSchedule(path, target, cost, steady_reference(path, target).profile)
