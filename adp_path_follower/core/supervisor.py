"""Whether the robot may move, and if not, why and what helps."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class State(Enum):
    """States of the controller."""

    INACTIVE = "inactive"
    WAITING = "waiting"
    FOLLOWING = "following"
    GOAL_REACHED = "goal reached"
    FAULT = "fault"


@dataclass(frozen=True)
class Status:
    """A state with its cause and what the user can do about it."""

    state: State
    cause: str = ""
    remedy: str = ""


class Supervisor:
    """Decide from the inputs' freshness and soundness whether the robot may move.

    A fault clears itself as soon as sound odometry returns. Times are steady seconds: they go on
    when the ROS clock stands still.
    """

    def __init__(self, odom_timeout: float) -> None:
        """Start without path and odometry; `odom_timeout` [s] may be changed later."""
        self.odom_timeout = odom_timeout
        self._odometry_time: float | None = None
        self._odometry_problem = ""
        self._has_path = False
        self._goal_reached = False
        self._command_problem = ""
        self.active = False

    def odometry_received(self, now: float, problem: str = "") -> None:
        """Note a message, and what is wrong with it."""
        self._odometry_time = now
        self._odometry_problem = problem
        self._command_problem = ""

    def path_received(self) -> None:
        """Note a new path."""
        self._has_path = True
        self._goal_reached = False

    def path_removed(self) -> None:
        """Note that there is no path any more."""
        self._has_path = False

    def goal_reached(self) -> None:
        """Note that the end of the path is reached."""
        self._goal_reached = True

    def command_refused(self, problem: str) -> None:
        """Note that no sound command could be found for the last odometry."""
        self._command_problem = problem

    def status(self, now: float) -> Status:
        """Return the state at a steady time [s]."""
        if not self.active:
            return Status(State.INACTIVE, "not activated", "call the lifecycle transition activate")
        if not self._has_path:
            return Status(State.WAITING, "no path", "publish a nav_msgs/Path on 'path'")
        if self._odometry_time is None:
            return Status(
                State.WAITING, "no odometry", "publish nav_msgs/Odometry on 'odom', or remap it"
            )
        age = now - self._odometry_time
        if age > self.odom_timeout:
            return Status(
                State.FAULT,
                f"no odometry for more than {self.odom_timeout:g} s",
                "check the odometry source; following goes on when it returns",
            )
        if self._odometry_problem:
            return Status(
                State.FAULT,
                self._odometry_problem,
                "check the odometry source; following goes on with the next sound message",
            )
        if self._command_problem:
            return Status(
                State.FAULT,
                self._command_problem,
                "learning was reset; following goes on with the next odometry",
            )
        if self._goal_reached:
            return Status(State.GOAL_REACHED, "end of the path", "publish another path")
        return Status(State.FOLLOWING)
