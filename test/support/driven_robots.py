"""Drives of the bench's robots, as the messages of a bag."""

from __future__ import annotations

import math

import numpy as np
from plants import STEP, AnalyticPlant
from robots import Robot

from bag_messages import SECOND, odometry, twist, twist_stamped

BEGIN = 1_700_000_000 * SECOND  # [ns]


def slalom(time):
    """Return v, w of a drive with stops and ever faster turns to both sides."""
    v = 0.5 if time % 9.0 < 7.5 else 0.0
    return v, 0.9 * math.sin(1.2 * time + 0.04 * time * time)


def straight(time):
    return 0.5, 0.0


def driven(robot: Robot, wanted, duration=30.0, rate=20.0, stamped=False):
    """Return the messages of a drive with commands at a rate [Hz]."""
    plant, found = AnalyticPlant(robot, np.zeros(3)), []
    every, command = round(1.0 / rate / STEP), np.zeros(2)
    for step in range(round(duration / STEP)):
        now = BEGIN + round(step * STEP * SECOND)
        if step % every == 0:
            command = np.array(wanted(step * STEP))
            message = twist_stamped(now, *command) if stamped else twist(*command)
            found.append(("/cmd_vel", now, message))
        plant.step(command)
        for item in plant.arrived():
            stamp = BEGIN + round(item.stamp * SECOND)
            measured = odometry(stamp, *item.pose, *item.twist.tolist())
            found.append(("/robot/odometry", now + round(STEP * SECOND), measured))
    return found
