"""Drive a recorded run again with a simulated robot, so that the effect on the motion shows."""

from __future__ import annotations

import numpy as np

from adp_path_follower.bags.reader import Run
from adp_path_follower.bags.replay import (
    RecordedDriver,
    Replay,
    Steps,
    recorded_settings,
    steps_of,
)
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings import Settings
from sim_unicycle.settings import PlantSettings
from sim_unicycle.unicycle import Unicycle

_NANOSECONDS = 1_000_000_000


def rerun(run: Run, settings: Settings | None = None) -> tuple[Replay, FloatArray]:
    """Return a run of the simulator from the recorded initial pose, as long as the recorded one.

    Paths and changes of parameters come when they came. The robot is the ideal unicycle.

    Args:
        run: The run.
        settings: What to drive it with; by default, what it was recorded with.

    Returns:
        The run, in which no command is a recorded one, and v, w at each step, shape (N, 2).

    Raises:
        FileError: As `replay`.

    """
    recorded = steps_of(run)
    driver = RecordedDriver(run, settings or recorded_settings(run))
    period = 1.0 / driver.settings.controller.controller_frequency
    first, last = int(recorded.stamp[0]), int(recorded.stamp[-1])
    stamps = first + np.arange(0, last - first + 1, round(period * _NANOSECONDS))
    robot = Unicycle(recorded.pose[0], PlantSettings())
    poses, velocities, outputs, cost = [], [], [], []
    for stamp in stamps.tolist():
        poses.append(robot.measured_pose())
        velocities.append(robot.twist)
        outputs.append(driver.step(poses[-1], stamp))
        cost.append(float(driver.follower.cost))
        if driver.at_goal:
            break
        robot.step(outputs[-1].command, period)
    count = len(outputs)
    arrivals = recorded.arrival[0] + stamps[:count] - first
    steps = Steps(stamps[:count], np.array(poses), arrivals)
    nothing = np.full((count, 2), np.nan)
    found = Replay(
        driver.follower,
        driver.settings,
        driver.route,
        driver.transform,
        steps,
        nothing,
        outputs,
        np.array(cost),
        driver.saved_weights,
    )
    return found, np.array(velocities)
