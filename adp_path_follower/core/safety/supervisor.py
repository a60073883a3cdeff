"""Decides whether the robot may move; if not, gives cause and remedy."""

import math
from dataclasses import dataclass
from enum import Enum

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.safety.odometry_check import OdometryProblem
from adp_path_follower.core.settings.groups import ControllerSettings
from adp_path_follower.core.settings.navigation import NavigationSettings


class State(Enum):
    """States of the controller."""

    INACTIVE = "inactive"
    WAITING = "waiting"
    FOLLOWING = "following"
    GOAL_REACHED = "goal reached"
    STOPPED = "stopped"
    FAULT = "fault"


class Kind(Enum):
    """Kinds of causes why a robot may not drive, for those who react to them."""

    INPUT = "input"  # odometry, clock, path or permission is missing or wrong
    DEVIATION = "deviation"  # the robot is not where it should be
    COMMAND = "command"  # no command may be sent
    TRANSFORM = "transform"  # the robot is not known in the frame of the path
    LATE = "late"  # the control step does not come
    PROGRESS = "progress"  # the robot does not get to the end of the path


@dataclass(frozen=True)
class Status:
    """A state with its cause and what the user can do about it."""

    state: State
    cause: str = ""
    remedy: str = ""
    kind: Kind = Kind.INPUT


_RESUME = "call ~/resume"
_SETTLED = 0.2  # [s] of sound odometry after wrong odometry: every second message may be wrong


def deviation(error: FloatArray, controller: ControllerSettings) -> str:
    """Return how an error [s, y, theta] exceeds the user's limits, empty if it does not."""
    _, cross_track, heading = abs(error).tolist()
    most, widest = controller.max_cross_track_error, controller.max_heading_error
    if cross_track > most:
        return f"cross-track error {cross_track:.3f} m is above max_cross_track_error {most:g}"
    if heading > widest:
        return f"heading error {heading:.3f} rad is above max_heading_error {widest:g}"
    return ""


class Supervisor:
    """Decide from the inputs' freshness and soundness whether the robot may move.

    A fault of the odometry, of the clock or of the command clears itself when sound odometry
    returns. A robot that was too far from the path, or may have been carried, waits for `resume`.
    Times are steady seconds: they advance while the ROS clock stands still.
    """

    def __init__(self, odom_timeout: float) -> None:
        self.odom_timeout = odom_timeout  # [s]; may be changed
        self.active = False
        self.tick_time: float | None = None  # of the last turn of the control timer
        self.clock_missing = False  # whether there is no clock for the control steps yet
        # Why the robot may not drive, empty if it may; the first two hold until `resume`.
        self.deviation = ""  # it is farther from the path than the user allows
        self.goal_problem = ""  # it will not get to the end of the path
        self.command_problem = ""  # no sound command could be found for the last odometry
        self.limit_problem = ""  # the last speed limit cannot hold
        self.transform_problem = ""  # the robot is not known in the frame of the path
        self.goal_reached = False
        self._odometry_time: float | None = None
        self._odometry_problem = ""
        self._sound_since: float | None = None  # after wrong odometry
        self._has_path = False
        self._stopped = False
        self._place: tuple[float, float] | None = None  # where it last made progress, and when
        self._since = 0.0

    def renewed(self) -> "Supervisor":
        """Return a supervisor without path and odometry that keeps the causes to `resume`."""
        other = Supervisor(self.odom_timeout)
        other._stopped, other.deviation = self._stopped, self.deviation
        return other

    def odometry_received(self, now: float, problem: OdometryProblem | None = None) -> None:
        """Note a message and its problem, None if it is sound."""
        self._odometry_time = now
        self.command_problem = ""
        if problem is not None:
            self._odometry_problem, self._sound_since = problem.text, None
            if problem.lasts:
                self.deviation = problem.text
        elif self._odometry_problem:
            if self._sound_since is None:
                self._sound_since = now
            if now - self._sound_since >= _SETTLED:
                self._odometry_problem = ""

    def look_for_progress(
        self, now: float, pose: FloatArray | None, settings: NavigationSettings
    ) -> None:
        """Note whether a robot on its way, at a pose (3,) and a time [s], gets anywhere."""
        if pose is None:  # it is not to drive, and has all the time anew
            self._place = None
            return
        place = float(pose[0]), float(pose[1])
        radius, allowance = settings.required_movement_radius, settings.movement_time_allowance
        if self._place is None or math.dist(place, self._place) >= radius or now < self._since:
            self._place, self._since = place, now
        if now - self._since > allowance:
            self.goal_problem = f"the robot moved less than {radius:g} m in {allowance:g} s"

    def path_received(self) -> None:
        """Note a new path."""
        self._has_path = True
        self.goal_reached, self.goal_problem = False, ""

    def path_removed(self) -> None:
        """Note that there is no path any more."""
        self._has_path = False

    def stop(self) -> None:
        """Stop on request."""
        self._stopped = True

    def resume(self) -> None:
        """Go on after a stop, or after the robot was too far from the path."""
        self._stopped, self.deviation, self.goal_problem = False, "", ""

    def status(self, now: float) -> Status:
        """Return the state at a steady time [s]."""
        if not self.active:
            return Status(State.INACTIVE, "not activated", "call the lifecycle transition activate")
        if self._stopped:
            return Status(State.STOPPED, "~/stop was called", _RESUME)
        found = self._waiting() or self._fault(now)
        if found is None and self.goal_reached:
            return Status(State.GOAL_REACHED, "end of the path", "publish another path")
        return found or Status(State.FOLLOWING)

    def patience(self, now: float) -> float:
        """Return how long inputs may stay silent [s] from a steady time [s] on."""
        heard = (self._odometry_time, self.tick_time)
        oldest = min((time for time in heard if time is not None), default=now)
        return oldest + self.odom_timeout - now

    def _waiting(self) -> Status | None:
        """Return the status of a missing input, None if there is none."""
        if self.clock_missing:
            return Status(
                State.WAITING,
                "no time on /clock",
                "start the publisher of /clock, or unset use_sim_time",
            )
        if not self._has_path:
            return Status(State.WAITING, "no path", "publish a nav_msgs/Path on 'path'")
        if self._odometry_time is None:
            return Status(
                State.WAITING, "no odometry", "publish nav_msgs/Odometry on 'odom', or remap it"
            )
        if self.transform_problem:
            remedy = "the robot resumes with the transform"
            return Status(State.WAITING, self.transform_problem, remedy, Kind.TRANSFORM)
        return None

    def _fault(self, now: float) -> Status | None:
        """Return the status of a fault, None if there is none."""
        assert self._odometry_time is not None  # else it is waited for
        timeout, tick = self.odom_timeout, self.tick_time
        silent = now - self._odometry_time > timeout
        late = tick is not None and now - tick > timeout
        faults = (
            (
                f"no odometry for more than {timeout:g} s" if silent else "",
                "check the odometry source; the robot resumes when it returns",
                Kind.INPUT,
            ),
            (
                f"no control step for more than {timeout:g} s" if late else "",
                "check /clock, which may stand still; the robot resumes with it",
                Kind.LATE,
            ),
            (self.deviation, f"check the robot, then {_RESUME}", Kind.DEVIATION),
            (
                self._odometry_problem,
                "check the odometry source; the robot resumes with sound messages",
                Kind.INPUT,
            ),
            (self.command_problem, "the robot resumes with the next odometry", Kind.COMMAND),
            (
                self.limit_problem,
                "the robot resumes with a speed limit above 0; to stop it, call ~/stop",
                Kind.INPUT,
            ),
            (self.goal_problem, f"publish another path, or {_RESUME} to try again", Kind.PROGRESS),
        )
        for cause, remedy, kind in faults:
            if cause:
                return Status(State.FAULT, cause, remedy, kind)
        return None
