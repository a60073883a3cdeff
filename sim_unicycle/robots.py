"""Robots by name: simulator parameters of config/robots, with their sources."""

from collections.abc import Mapping

from adp_path_follower.core.settings.parameter_file import read_parameters
from adp_path_follower.core.settings.schema import build
from adp_path_follower.resources import shipped_file
from sim_unicycle.settings import SimulatorSettings


def with_robot(values: Mapping[str, object]) -> dict[str, object]:
    """Return the parameters of the robot that 'robot' names, changed by the given ones.

    Raises FileError if there is no such robot.
    """
    name = values.get("robot")
    if not name:
        return dict(values)
    return {**read_parameters(shipped_file("robots", str(name), "robot"), "unicycle_sim"), **values}


def simulator_settings(values: Mapping[str, object]) -> SimulatorSettings:
    """Return the simulator's settings; AdpError for a robot or value that there is not."""
    return build(SimulatorSettings, with_robot(values))
