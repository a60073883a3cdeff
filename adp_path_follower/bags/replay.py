"""Feed the odometry of a recorded run to `PathFollower` again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import yaml

from adp_path_follower.bags.reader import Run
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.files import parse_yaml
from adp_path_follower.core.follower import FollowerOutput, PathFollower
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path import Path
from adp_path_follower.core.schema import build
from adp_path_follower.core.settings import Settings


@dataclass(frozen=True)
class Replay:
    """What `PathFollower` makes of recorded odometry.

    Attributes:
        follower: The follower after the run.
        stamp: Time of each control step [ns], shape (N,).
        odometry: x, y, theta, v, w at each step, shape (N, 5).
        recorded: The commands [v, w] in the bag, shape (N, 2).
        outputs: What the follower gave, one for each step.

    """

    follower: PathFollower
    stamp: np.ndarray
    odometry: FloatArray
    recorded: FloatArray
    outputs: list[FollowerOutput]

    @property
    def identical(self) -> np.ndarray:
        """Return for each step whether both commands are equal to the last bit, shape (N,)."""
        return np.asarray((self.replayed == self.recorded).all(axis=1))

    @property
    def replayed(self) -> FloatArray:
        """Return the follower's commands [v, w], shape (N, 2)."""
        return np.array([output.command for output in self.outputs])


def replay(run: Run, settings: Settings | None = None) -> Replay:
    """Replay a run whose control steps were started by odometry (control_trigger: odometry).

    Args:
        run: The run.
        settings: What to replay it with; by default, what it was recorded with.

    Raises:
        FileError: The bag lacks odometry, commands, path or configuration, its steps were started
            by a timer, or a pose is none that a robot can have.

    """
    for name in ("odom", "cmd_vel"):
        if name not in run.series:
            raise FileError(f"the bag has no messages on '{name}': nothing to replay")
    if not len(run.path_points):
        raise FileError("the bag has no path: nothing to replay")
    recorded_with = recorded_settings(run)
    settings = settings or recorded_with
    if recorded_with.controller.control_trigger != "odometry":
        raise FileError("the bag was recorded with control_trigger: timer; replay needs odometry")
    path = Path.from_points(run.path_points)
    # The simulator repeats odometry that was not answered in time, the controller its answer:
    # the first of each stamp counts.
    odometry_stamps, first = np.unique(run.series["odom"].stamp, return_index=True)
    odometry = run.series["odom"].values[first]
    command_stamps, first = np.unique(run.series["cmd_vel"].stamp, return_index=True)
    commands = run.series["cmd_vel"].values[first]
    steps, in_odometry, in_commands = np.intersect1d(
        odometry_stamps, command_stamps, return_indices=True
    )
    if not len(steps):
        raise FileError("no command in the bag answers an odometry message: nothing to replay")
    odometry, commands = odometry[in_odometry], commands[in_commands]
    if not np.isfinite(odometry[:, :3]).all():
        raise FileError("the bag has odometry that is not finite: it cannot be replayed")
    at_beginning = recorded_with.controller.path_start == "beginning"
    follower = PathFollower(settings, path, 0.0 if at_beginning else path.nearest(odometry[0, :3]))
    outputs = []
    for row, stamp in zip(odometry, steps, strict=True):
        try:
            with np.errstate(all="ignore"):  # a damaged pose is told below, once
                outputs.append(follower.step_at(row[:3], int(stamp)))
            sound = bool(np.isfinite(outputs[-1].command).all())
        except (ArithmeticError, LookupError, ValueError):
            sound = False
        if not sound:  # where no robot ever was
            pose = ", ".join(f"{value:g}" for value in row[:3])
            raise FileError(f"no command follows from the pose ({pose}) at {stamp} ns")
        if not path.closed and float(follower.arc_length) >= path.length:
            break  # the goal: from here on the node commands zero velocity
    count = len(outputs)
    return Replay(follower, steps[:count], odometry[:count], commands[:count], outputs)


def recorded_settings(run: Run) -> Settings:
    """Return the settings that the controller said it runs with.

    Raises:
        FileError: The bag has none, or none that can be read.
        SettingsError: They are none of this version.

    """
    try:
        content = parse_yaml(run.configuration)
    except yaml.YAMLError:
        content = None
    values = content.get("settings") if isinstance(content, dict) else None
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise FileError("the bag has no sound path_follower/configuration: nothing to replay")
    return build(Settings, values)
