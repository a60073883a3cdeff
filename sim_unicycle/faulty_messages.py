"""Odometry messages of the simulator, sound or faulty."""

import math
from collections.abc import Callable

import numpy as np
from nav_msgs.msg import Odometry

from adp_path_follower.ros.runtime.conversions import NANOSECONDS, odometry_message
from sim_unicycle.odometry import Reading
from sim_unicycle.settings import SimulatorSettings


def _set_position(value: float) -> Callable[[Odometry], None]:
    def corrupt(message: Odometry) -> None:
        message.pose.pose.position.x = value

    return corrupt


def _remove_orientation(message: Odometry) -> None:
    message.pose.pose.orientation.z = message.pose.pose.orientation.w = 0.0


_CORRUPTIONS: dict[str, Callable[[Odometry], None]] = {
    "nan": _set_position(math.nan),
    "infinite": _set_position(math.inf),
    "zero_quaternion": _remove_orientation,
}


def published_time(time: int, settings: SimulatorSettings) -> int:
    """Return the time on /clock [ns] at a simulated time [ns]."""
    return max(1, time + round(NANOSECONDS * settings.message_faults.clock_offset))


def odometry_of(reading: Reading, time: int, settings: SimulatorSettings) -> Odometry:
    """Return the message of a reading at a simulated time [ns], with the faults of the settings."""
    faults, simulation = settings.message_faults, settings.simulation
    frames = (
        faults.reported_odom_frame or simulation.odom_frame,
        faults.reported_base_frame or simulation.base_frame,
    )
    stamp = published_time(time, settings) + round(NANOSECONDS * faults.odometry_stamp_offset)
    pose = reading.pose + np.array(faults.odometry_offset)
    message = odometry_message(max(0, stamp), pose, reading.twist, frames)
    if faults.odometry_corruption in _CORRUPTIONS:
        _CORRUPTIONS[faults.odometry_corruption](message)
    return message
