"""The robot between controller and world: with its model known, it is an ideal unicycle."""

import dataclasses
import math
from dataclasses import replace

import numpy as np

from adp_path_follower.core.control.actuation import limited_command
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.compensation import (
    compensated,
    ideal_state,
    lag_left,
    let_through,
)
from adp_path_follower.core.robot.estimator import StateEstimator
from adp_path_follower.core.robot.history import CommandHistory
from adp_path_follower.core.robot.model import RobotModel, RobotState, advanced
from adp_path_follower.core.robot.response import ResponseBank
from adp_path_follower.core.robot.trial import Trial
from adp_path_follower.core.settings.groups import Settings

_SETTLING = 0.3  # [s] over which the model that drives follows the one that was found
_REVIEW = 0.2  # [s] between two looks at the bank
_LONGEST_GAP = 1.0  # [s] between two steps of a robot that was controlled all the time
_SHORTEST_PERIOD = 1e-6  # [s]
_LONGEST_PERIOD = 0.1  # [s]: after a pause a command does not make up for it
_STEEP = 3.0  # [m/s^2] of a ramp that is felt no more than none
_LONG_AGO = -10.0  # [s]: by now it does what it was told
_CLIPPED = 0.02  # [m/s, rad/s] by which a limit changes a command


def model_of(settings: Settings) -> RobotModel:
    """Return the model that settings describe."""
    robot = settings.robot
    return RobotModel(
        delay=settings.motion.actuation_delay,
        linear_lag=robot.robot_lags[0],
        angular_lag=robot.robot_lags[1],
        ramp=robot.robot_ramps[0],
        angular_ramp=robot.robot_ramps[1],
        linear_gain=robot.robot_gains[0],
        angular_gain=robot.robot_gains[1],
        bias=robot.robot_bias,
    )


def settings_of(model: RobotModel) -> dict[str, object]:
    """Return the settings that describe a model, as `robot_model: given` takes them."""
    return {
        "robot_model": "given",
        "actuation_delay": model.delay,
        "robot_lags": (model.linear_lag, model.angular_lag),
        "robot_ramps": model.ramps,
        "robot_gains": (model.linear_gain, model.angular_gain),
        "robot_bias": model.bias,
    }


class Robot:
    """Tells the controller where the robot will be, and the robot what makes it go there."""

    def __init__(self, settings: Settings, learned: tuple[float, ...] = ()) -> None:
        """Begin with the model of the settings, or with one that was learned before."""
        self.settings = settings
        self.measured = False  # whether its motion was known at the last step
        self._last = np.zeros(2)  # the command that it was sent last, and ...
        self._compensated = False  # ... whether that is another one than the controller wanted
        self.reset(RobotModel(*learned) if learned else None)

    def reset(self, learned: RobotModel | None = None) -> None:
        """Forget what was learned, but for a model that was learned before."""
        self._start = model_of(self.settings)
        self.model = start = self._start
        if learned is not None and self.settings.robot.robot_model == "learned":
            self.model = start = learned
        self._kind = self.settings.robot.robot_model
        self._learns = self._kind == "learned"
        self._history = self._begun_history()
        self._estimator = StateEstimator(start, self._learns)
        self._bank = ResponseBank(start)
        self._trial = Trial()
        self._found = self._unknown = self._bank.response()
        self._origin: int | None = None
        self._now = self._review = 0.0
        # From the last command to the next.
        self._period = 1.0 / self.settings.controller.controller_frequency
        self._rate = np.zeros(2)
        self._reading: tuple[float, float, float] | None = None
        self._acting: RobotState | None = None  # when the next command begins to act
        self._ahead = 0.0
        # Whether nothing tells the robot from an ideal one that is observed well.
        self._plain = self._learns and start.ideal
        self._shown = 0  # the time for which the controller was asked last [ns]

    def take_over(self, settings: Settings) -> None:
        """Go on with other settings; what was learned stays unless they describe another robot."""
        same = settings.robot == self.settings.robot and model_of(settings) == self._start
        self.settings = settings
        if not same:
            self.reset()

    def restart(self) -> None:
        """Begin anew where the robot will be: it was not observed, or carried."""
        self._origin = None
        self._estimator.forget_state()
        self._bank.restart()
        self._trial.restart()
        self._history = self._begun_history()
        self._now = self._review = 0.0
        self._acting = self._reading = None

    def _begun_history(self) -> CommandHistory:
        """Return a history of what the robot is doing since long ago."""
        history = CommandHistory()
        history.ramps = self.model.ramps
        if self._last.any():
            v, w = self._last.tolist()
            history.send(_LONG_AGO, (v, w))
        return history

    @property
    def problem(self) -> str:
        """Return why the ideal model drives in place of the learned one, empty if it does not."""
        if self._bank.opposed:
            return "the twist of the odometry contradicts the commands"
        if self._trial.failed:
            return "the robot's model explains its motion worse than the ideal one"
        return ""

    @property
    def ideal(self) -> bool:
        """Return whether the last step took the robot for an ideal one."""
        return self._acting is None or self.model.ideal

    @property
    def acceleration(self) -> float:
        """Return how fast its speed may change along a path [m/s^2]; an ideal one's at once."""
        return math.inf if self.ideal else min(self.model.ramp, _STEEP)

    @property
    def learned(self) -> tuple[float, ...]:
        """Return the parameters of the model to begin with another time, if it is learned."""
        return dataclasses.astuple(self.model) if self._learns else ()

    @property
    def report(self) -> dict[str, float]:
        """Return the model's parameters, deviations and what it explains; empty where ideal."""
        if self._kind == "ideal":
            return {}
        model, found = self.model, self._found.deviations
        spread = (*found, *self._estimator.deviations.tolist()) if self._learns else (0.0,) * 6
        names = ("delay [s]", "linear lag [s]", "angular lag [s]", "k_v", "k_w", "bias [rad/m]")
        lags = (model.linear_lag, model.angular_lag)
        values = (model.delay, *lags, model.linear_gain, model.angular_gain, model.bias)
        return {
            **dict(zip(names, values, strict=True)),
            "ramp [m/s^2]": model.ramp,
            "angular ramp [rad/s^2]": model.angular_ramp,
            **{f"deviation of {name}": size for name, size in zip(names, spread, strict=True)},
            "explained": self._trial.explained,
        }

    def ahead(
        self, pose: FloatArray, time: int, motion: FloatArray | None
    ) -> tuple[FloatArray, int]:
        """Return where the robot is when the next command is at work, and when that is [ns].

        `pose` (3,) is odometry's, moved on to now, `time` [ns]; `motion` its v, w and age [s], if
        known.
        """
        self._acting, self.measured = None, motion is not None
        if self._kind == "ideal" or motion is None:
            self._origin = None
            return pose, time
        if self._origin is None:
            self._origin, self._shown = time, time
        now = (time - self._origin) * 1e-9
        if not 0.0 <= now - self._now <= _LONGEST_GAP:
            self.restart()
            self._origin, self._shown, now = time, time, 0.0
        elapsed, self._now = now - self._now, now
        self._period = 1.0 / self.settings.controller.controller_frequency
        if elapsed > _SHORTEST_PERIOD and self._history.last != (0.0, 0.0):
            self._period = min(elapsed, _LONGEST_PERIOD)
        self._take(pose.tolist(), *motion.tolist())
        self._settle(elapsed)
        if self._plain or self.problem or self._bank.held:
            return pose, time
        model, known = self.model, self._estimator.stamp
        assert known is not None  # it has just taken in a message
        history = self._history
        acting = advanced(model, self._estimator.state, history.held(known - model.delay, now))
        self._acting, self._ahead = acting, lag_left(model)
        later = ideal_state(model, acting, self._ahead)
        seen = time + round(1e9 * (model.delay + self._ahead))
        self._shown = max(seen, self._shown + round(0.5e9 * elapsed))  # time never runs back
        return np.array([later.x, later.y, later.theta]), self._shown

    def _take(self, pose: list[float], v: float, w: float, age: float) -> None:
        """Take in odometry, back at its stamp."""
        x, y, theta = pose
        half = 0.5 * w * age
        chord = v * age * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        middle = theta - half
        place = (x - chord * math.cos(middle), y - chord * math.sin(middle), middle - half)
        stamp = self._now - age
        self._reading = (stamp, v, w)
        estimator = self._estimator
        estimator.unanswered = self._bank.unanswered
        if self._bank.held:  # the model would have it move
            estimator.forget_state()
        elif estimator.observe(stamp, place, (v, w), self.model, self._history):
            self._trial.observe(stamp, estimator.state, self.model, self._history)

    def _settle(self, elapsed: float) -> None:
        """Let the model that drives follow the one that was found."""
        if not self._learns:
            return
        share, found, model = -math.expm1(-elapsed / _SETTLING), self._found, self.model
        model = replace(
            model,
            delay=model.delay + share * (found.delay - model.delay),
            linear_lag=model.linear_lag + share * (found.linear_lag - model.linear_lag),
            angular_lag=model.angular_lag + share * (found.angular_lag - model.angular_lag),
            ramp=found.ramp,
            angular_ramp=found.angular_ramp,
        )
        told = self._estimator.tells_more or found != self._unknown
        self._plain = self._plain and (self._bank.unanswered or not told)
        self.model = model if self._plain else self._estimator.with_gains(model)
        self._history.ramps = self.model.ramps

    def command(self, wanted: FloatArray) -> FloatArray:
        """Return what to send for a motion [V, W] that the controller wants, shape (2,)."""
        if self._acting is None and not self._compensated:
            self._send(wanted)
            return wanted
        settings, found = self.settings, wanted
        limits, command = settings.limits, wanted
        if self._acting is not None:
            found = compensated(self.model, self._acting, wanted, self._ahead, self._period)
            command = np.minimum(np.maximum(found, limits.lower), limits.upper)
            reached = self._history.reached(self._now)
            command = let_through(self.model, command, reached, self._period)
        if settings.motion.limited:
            command = limited_command(
                command, self._last, self._rate, limits, settings.motion, self._period
            )
            self._rate = (command - self._last) / self._period
        self._compensated = bool((command != wanted).any())
        clipped = bool((np.abs(command - found) > _CLIPPED).any())
        self._estimator.frozen = clipped or self._bank.unanswered or self._bank.hurried
        self._send(command)
        return command

    def _send(self, command: FloatArray) -> None:
        self._last = command
        if self._origin is not None:
            v, w = command.tolist()
            self._history.send(self._now, (v, w))

    def note(self, command: FloatArray) -> None:
        """Note a command, shape (2,), that is not the controller's: a stop, a turn on the spot."""
        self._send(command)
        self._compensated = False
        self._bank.restart()

    def learn(self) -> None:
        """Learn from the last step."""
        if not self._learns or self._reading is None:
            return
        self._bank.advance(self._now, self._history.last)
        self._bank.observe(*self._reading)
        if self._now >= self._review and not self._bank.unanswered:
            self._review = self._now + _REVIEW
            self._found = self._bank.response()
