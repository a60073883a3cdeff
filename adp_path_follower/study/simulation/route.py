"""The closed loop on a route: segments in reverse, turns on the spot, a heading at the goal."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.geometry import FloatArray, pose_in_frame
from adp_path_follower.core.path.route import Route
from adp_path_follower.core.settings.groups import Settings
from sim_unicycle.settings import PlantSettings
from sim_unicycle.unicycle import Unicycle


@dataclass(frozen=True)
class RouteRun:
    """The outcome of one run."""

    start: FloatArray  # error [s, y, theta] at the first pose, shape (3,)
    cost: float  # J by control steps, over all segments
    goal_time: float  # when the goal was reached [s], infinite if it was not
    final_pose: FloatArray  # true x [m], y [m], theta [rad] at the end, shape (3,)
    max_inputs: FloatArray  # largest |v| and |w| commanded, shape (2,)
    reversed_for: float  # time with a command to drive backwards [s]


def is_plain(route: Route) -> bool:
    """Return whether a route is a path that is driven forwards, and nothing else."""
    (first, *rest) = route.segments
    turns = first.turn_first or route.goal_heading is not None
    return not (rest or first.reverse or turns)


def simulate_route(
    settings: Settings,
    route: Route,
    starts: FloatArray,
    duration: float,
    rate: float,
    plant: PlantSettings,
    progress: Callable[[float], None],
) -> list[RouteRun]:
    """Return the runs from starts [s, y, theta] (B, 3) at the first pose, one after the other."""
    runs = []
    first = route.segments[0]
    frame = first.heading_of_path(first.path.frame(0.0).pose)
    period = 1.0 / rate
    for number, start in enumerate(starts):
        robot, driver = Unicycle(pose_in_frame(start, frame), plant, number), Driver(settings)
        driver.follow(route)
        costs: dict[int, float] = {}
        highest, goal_time, backwards = np.zeros(2), math.inf, 0.0
        for step in range(round(duration * rate) + 1):
            pose, motion = robot.present_pose(), robot.measured_motion()
            output = driver.step(pose, round((step + 1) * 1e9 * period), motion)
            assert driver.follower is not None  # the step has made one
            costs[driver.segment] = float(driver.follower.cost)
            if driver.at_goal:
                goal_time = step * period
                break
            highest = np.maximum(highest, np.abs(output.command))
            backwards += period * float(output.command[0] < 0.0)
            robot.step(output.command, period)
        cost = sum(costs.values())
        runs.append(RouteRun(start, cost, goal_time, robot.pose, highest, backwards))
        progress((number + 1) / len(starts))
    return runs
