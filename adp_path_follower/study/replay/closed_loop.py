"""Drive a recorded run again with a simulated robot, so that the effect on the motion shows."""

from collections.abc import Mapping

import numpy as np

from adp_path_follower.bags.reader import Run
from adp_path_follower.core.driving.command_law import FollowerOutput
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.study.replay.recorded_driver import RecordedDriver, recorded_settings
from adp_path_follower.study.replay.replay import Replay, Steps, steps_of
from sim_unicycle.settings import PlantSettings
from sim_unicycle.unicycle import Unicycle

_NANOSECONDS = 1_000_000_000


def rerun(
    run: Run, settings: Settings | None = None, overlay: Mapping[str, object] | None = None
) -> tuple[Replay, FloatArray]:
    """Return a run of the simulator from the recorded initial pose, as long as the recorded one.

    Paths and changes of parameters come when they came; `settings` and `overlay` are as in
    `replay`, as are the errors raised. The robot is the ideal unicycle. Returns the run, in which
    no command is a recorded one, and v, w at each step, shape (N, 2).
    """
    recorded = steps_of(run)
    if settings is None and "measured_pose" not in run.series:
        settings = recorded_settings(run)  # such a bag does not say which steps a change is between
    driver = RecordedDriver(run, settings, overlay)
    stamp, last = int(recorded.stamp[0]), int(recorded.stamp[-1])
    robot = Unicycle(recorded.pose[0], PlantSettings())
    stamps, poses, velocities, cost = [], [], [], []
    outputs: list[FollowerOutput] = []
    while stamp <= last and not (outputs and driver.at_goal):
        stamps.append(stamp)
        poses.append(robot.measured_pose())
        velocities.append(robot.twist)
        outputs.append(driver.step(poses[-1], stamp))
        cost.append(float(driver.follower.cost))
        period = 1.0 / driver.settings.controller.controller_frequency
        robot.step(outputs[-1].command, period)
        stamp += round(period * _NANOSECONDS)
    count = len(outputs)
    stamp_array = np.array(stamps)
    steps = Steps(stamp_array, np.array(poses), recorded.arrival[0] + stamp_array - stamp_array[0])
    nothing = np.full((count, 2), np.nan)
    found = Replay(
        driver.follower,
        driver.settings,
        steps,
        nothing,
        outputs,
        np.array(cost),
        tuple(driver.configurations),
    )
    return found, np.array(velocities)
