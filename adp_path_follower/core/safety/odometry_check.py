"""Checks odometry messages against the clock, their limits and the ones before."""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray, advance_pose, wrap_angle
from adp_path_follower.core.settings.groups import ControllerSettings, Settings

_NANOSECONDS = 1_000_000_000
_FARTHEST = 1e8  # [m] from the origin, as for paths
_FASTEST = 1e4  # [m/s], [rad/s]
_FASTER = 3.0  # times the limits of the command, and ...
_FASTER_BY = (1.0, 3.0)  # ... [m/s, rad/s] more: no base overshoots its commands like that
_HEADING_TOLERANCE = 1.0  # [rad] beyond what the angular velocity explains
_STEADY, _STEADY_STEPS = 0.05, 2  # [m] and messages of a motion without velocities
_SMOOTHING = 0.05  # [s] of velocities from poses
_MEMORY = 0.5  # [s] over which motion that velocities do not explain adds up
_LONGEST_PREDICTION = 1.0  # [s]


@dataclass(frozen=True)
class Measurement:
    """The parts of an odometry message that the controller uses."""

    stamp: int  # time of the message [ns]
    pose: FloatArray  # x [m], y [m], theta [rad], shape (3,)
    twist: FloatArray  # v [m/s], w [rad/s], shape (2,)
    frame: str  # frame of the pose
    child_frame: str  # frame of the robot

    def pose_at(self, time: int) -> FloatArray:
        """Return the pose at a time [ns] by constant twist; as measured for another clock."""
        age = self._age(time)
        if age == 0.0:
            return self.pose
        return advance_pose(self.pose, self.twist[0], self.twist[1], age)

    def motion_at(self, time: int) -> FloatArray:
        """Return v [m/s], w [rad/s] and how long [s] `pose_at` has moved the pose on, (3,)."""
        return np.array([*self.twist, self._age(time)])

    def _age(self, time: int) -> float:
        age = (time - self.stamp) / _NANOSECONDS
        return age if 0.0 < age < _LONGEST_PREDICTION else 0.0


@dataclass(frozen=True)
class OdometryProblem:
    """A reason to reject an odometry message."""

    text: str  # one sentence
    # Whether `resume` must be called before the robot drives on, because the robot or its place may
    # have changed.
    lasts: bool = False


class OdometryCheck:
    """Compares each odometry message with those before it."""

    def __init__(self) -> None:
        self._last: Measurement | None = None
        self._unexplained = (0.0, 0.0)  # [m] along x and y
        self._fastest = (0.0, 0.0)  # [m/s, rad/s] that the robot was allowed

    def problem(self, now: int, found: Measurement, settings: Settings) -> OdometryProblem | None:
        """Return the problem of a message at a time [ns] (0: not known), None if it is sound.

        After a step back of the stamps, and after a jump, the next message is compared with this
        one, so the fault ends by itself when the messages agree again. Another robot frame does
        not, nor a robot that is elsewhere after a silence.
        """
        last = self._last
        self._fastest = tuple(map(max, self._fastest, settings.limits.upper.tolist()))
        text = self._impossible(*found.pose[:2].tolist(), *found.twist.tolist())
        if text:
            return OdometryProblem(text)
        if last is not None and found.child_frame != last.child_frame:
            return OdometryProblem(
                f"odometry is of '{found.child_frame}' now, and was of '{last.child_frame}': two "
                "sources on one topic?"
            )
        problem = None if last is None else self._motion_problem(last, found, settings.controller)
        if now and not (problem and problem.lasts):
            text = stamp_problem(now, found.stamp, settings.controller)
            problem = OdometryProblem(text) if text else problem
        self._last = found
        return problem

    def _impossible(self, x: float, y: float, v: float, w: float) -> str:
        """Return why a place [m] and a velocity [m/s, rad/s] are impossible, empty if not."""
        near, slow = (abs(x) <= _FARTHEST >= abs(y)), (abs(v) <= _FASTEST >= abs(w))
        if not (near and slow):  # NaN too
            return (
                f"odometry out of range: x {x:.3g} m, y {y:.3g} m, v {v:.3g} m/s, w {w:.3g} rad/s; "
                "check its units"
            )
        names = ("linear", "m/s"), ("angular", "rad/s")
        for (name, unit), value, limit, more in zip(
            names, (v, w), self._fastest, _FASTER_BY, strict=True
        ):
            if abs(value) > _FASTER * limit + more:
                return (
                    f"odometry says {value:.3g} {unit}, but max_{name}_vel is {limit:g}: check its "
                    "units, and whether another node drives the robot"
                )
        return ""

    def _motion_problem(
        self, last: Measurement, found: Measurement, controller: ControllerSettings
    ) -> OdometryProblem | None:
        """Return why a message contradicts the last one, None if it does not."""
        tolerance = controller.odom_jump_tolerance
        elapsed = (found.stamp - last.stamp) / _NANOSECONDS
        x, y, turned = (found.pose - last.pose).tolist()
        moved = math.hypot(x, y)
        if not 0.0 <= elapsed <= controller.odom_timeout:
            return self._after_silence(elapsed, moved, tolerance)
        explained, turn = (elapsed * np.maximum(abs(last.twist), abs(found.twist))).tolist()
        if moved > explained + tolerance:
            self._unexplained = (0.0, 0.0)
            return OdometryProblem(
                f"odometry jumped by {moved:.2f} m in {elapsed:.3f} s, where its velocity explains "
                f"{explained:.2f} m"
            )
        turned = abs(float(wrap_angle(turned)))
        if turned > turn + _HEADING_TOLERANCE and math.isfinite(tolerance):
            return OdometryProblem(
                f"odometry turned by {turned:.2f} rad in {elapsed:.3f} s, where its velocity "
                f"explains {turn:.2f} rad"
            )
        return self._drift_problem((x, y), explained, elapsed, tolerance)

    def _after_silence(
        self, elapsed: float, moved: float, tolerance: float
    ) -> OdometryProblem | None:
        """Return why a robot may be elsewhere after stamps [s] that went back or ended for a time.

        It was told to stop, but not surely in time, so it may have driven as far as it could.
        """
        self._unexplained = (0.0, 0.0)
        if moved > max(elapsed, 0.0) * self._fastest[0] + tolerance:
            how = f"came {elapsed:.1f} s later" if elapsed > 0.0 else "went back in time"
            return OdometryProblem(
                f"odometry {how}, and is {moved:.2f} m from where it was: was its source restarted "
                "or the robot carried?",
                lasts=True,
            )
        if elapsed < 0.0:
            return OdometryProblem(f"odometry stamps went back by {-elapsed:.3f} s")
        return None

    def _drift_problem(
        self, moved: tuple[float, float], explained: float, elapsed: float, tolerance: float
    ) -> OdometryProblem | None:
        """Return a problem if motion [m] that velocities do not explain adds up; noise does not."""
        distance = math.hypot(*moved)
        share = 1.0 - explained / distance if distance > explained else 0.0
        kept = math.exp(-elapsed / _MEMORY)
        drift = tuple(
            kept * old + share * new for old, new in zip(self._unexplained, moved, strict=True)
        )
        self._unexplained = (drift[0], drift[1])
        if math.hypot(*drift) <= tolerance:
            return None
        self._unexplained = (0.0, 0.0)
        return OdometryProblem(
            f"odometry has moved by {math.hypot(*drift):.2f} m within about {_MEMORY:g} s that its "
            "velocity does not explain"
        )


class MissingTwist:
    """Takes the velocity of a robot from its poses, where odometry has none.

    Odometry has none if v and w are exactly zero in every message, while the pose moves steadily.
    """

    def __init__(self) -> None:
        self.missing = False  # whether odometry was found to have no velocity
        self._given = False  # whether any message had one
        self._first: FloatArray | None = None  # [m]: where a steady motion began, shape (2,)
        self._steps = 0  # of it
        self._last: Measurement | None = None
        self._twist: FloatArray = np.zeros(2)

    def twist(self, found: Measurement, settings: Settings) -> FloatArray:
        """Return [v, w] of a message, (2,), from the poses where it gives none."""
        if self._given or found.twist.any():
            self._given, self.missing = True, False
            return found.twist
        last, self._last = self._last, found
        elapsed = 0.0 if last is None else (found.stamp - last.stamp) / _NANOSECONDS
        if last is None or not 0.0 < elapsed <= settings.controller.odom_timeout:
            self._first, self._steps, self._twist = None, 0, np.zeros(2)
            return found.twist
        x, y, turned = (found.pose - last.pose).tolist()
        turned = float(wrap_angle(turned))
        heading = float(last.pose[2]) + 0.5 * turned
        ahead = x * math.cos(heading) + y * math.sin(heading)
        kept = math.exp(-elapsed / _SMOOTHING)
        self._twist = kept * self._twist + (1.0 - kept) / elapsed * np.array([ahead, turned])
        fastest = _FASTER * float(settings.limits.upper[0]) + _FASTER_BY[0]
        if math.hypot(x, y) > fastest * elapsed:
            self._first, self._steps, self._twist = None, 0, np.zeros(2)
            return found.twist  # it jumped
        self._first = last.pose[:2] if self._first is None else self._first
        self._steps += 1
        if self._steps >= _STEADY_STEPS and math.dist(self._first, found.pose[:2]) > _STEADY:
            self.missing = True
        return self._twist if self.missing else found.twist


def stamp_problem(now: int, stamp: int, controller: ControllerSettings) -> str:
    """Return why a stamp [ns] is too far from the present time [ns], empty if it is not."""
    age = (now - stamp) / _NANOSECONDS
    if age > controller.odom_timeout:
        return f"odometry is {age:.2f} s old by its stamp: are the clocks synchronised?"
    if age < -controller.odom_timeout:
        return f"odometry is {-age:.2f} s ahead by its stamp: are the clocks synchronised?"
    return ""
