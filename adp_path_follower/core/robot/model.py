"""How a robot answers its commands: delay, lag, ramp, gains and bias.

A command [v_c, w_c] sent at t acts from t + delay on. The firmware limits the change of v_c to a
ramp, and that of w_c to another. The wheels, whose v and w the encoders tell, and the robot follow:

    v' = (v_c - v) / lag_v,    w' = (w_c - w) / lag_w,
    V = k_v v,    W = k_w w + b v,    x' = V cos(theta),    y' = V sin(theta),    theta' = W,

for wheels of another size or distance than the firmware believes, and of two sizes.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

from adp_path_follower.core.geometry import FloatArray

_Velocity = TypeVar("_Velocity", float, FloatArray)


@dataclass(frozen=True)
class RobotModel:
    """The parameters of one robot; those of the defaults are an ideal unicycle's."""

    delay: float = 0.0  # time from a command to its effect [s]
    linear_lag: float = 0.0  # time constant of v [s]
    angular_lag: float = 0.0  # time constant of w [s]
    ramp: float = math.inf  # highest rate of change of v_c that the firmware lets through [m/s^2]
    linear_gain: float = 1.0  # k_v, true velocity by the encoders' one
    angular_gain: float = 1.0  # k_w, the same for the turn rate
    bias: float = 0.0  # b, turn rate that comes with the velocity [rad/m]
    angular_ramp: float = math.inf  # highest rate of change of w_c [rad/s^2]

    @property
    def ramps(self) -> tuple[float, float]:
        """Return the highest rates of change of v_c and w_c [m/s^2, rad/s^2]."""
        return self.ramp, self.angular_ramp

    @property
    def ideal(self) -> bool:
        """Return whether this is the ideal unicycle."""
        return self == IDEAL

    @property
    def possible(self) -> bool:
        """Return whether a robot can be like this; false where a number is none."""
        gains = 0.5 <= self.linear_gain <= 2.0 and 0.5 <= self.angular_gain <= 2.0
        times = (self.delay, self.linear_lag, self.angular_lag)
        return (
            gains
            and all(0.0 <= time <= 2.0 for time in times)
            and min(self.ramps) > 0.0
            and (abs(self.bias) <= 1.0)
        )

    def motion(self, v: _Velocity, w: _Velocity) -> tuple[_Velocity, _Velocity]:
        """Return how the robot moves [m/s, rad/s] with the wheels' velocities, any shape."""
        return self.linear_gain * v, self.angular_gain * w + self.bias * v

    def wheels(self, v: _Velocity, w: _Velocity) -> tuple[_Velocity, _Velocity]:
        """Return the wheels' velocities with which the robot moves [m/s, rad/s], any shape."""
        v = v / self.linear_gain
        return v, (w - self.bias * v) / self.angular_gain


IDEAL = RobotModel()


@dataclass(frozen=True)
class RobotState:
    """Where a robot is and how its wheels turn."""

    x: float  # position [m]
    y: float  # position [m]
    theta: float  # heading [rad]
    v: float = 0.0  # the wheels' velocity [m/s]
    w: float = 0.0  # the wheels' turn rate [rad/s]


# A command [m/s, rad/s] and the time for which it acts [s].
Held = tuple[float, float, float]


def response(now: float, wanted: float, dt: float, lag: float) -> tuple[float, float]:
    """Return a wheel velocity after dt, and the distance meanwhile, exactly."""
    gap = now - wanted
    faded = gap * math.exp(-dt / lag) if lag > 0.0 else 0.0
    return wanted + faded, wanted * dt + lag * (gap - faded)


def advanced(model: RobotModel, state: RobotState, commands: Iterable[Held]) -> RobotState:
    """Return the state after commands in turn, each driven as one arc of exact length and turn."""
    x, y, theta, v, w = state.x, state.y, state.theta, state.v, state.w
    gain, turn_gain, bias = model.linear_gain, model.angular_gain, model.bias
    for wanted_v, wanted_w, dt in commands:
        v, rolled = response(v, wanted_v, dt, model.linear_lag)
        w, turned = response(w, wanted_w, dt, model.angular_lag)
        half = 0.5 * (turn_gain * turned + bias * rolled)
        chord = gain * rolled * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        middle = theta + half
        x += chord * math.cos(middle)
        y += chord * math.sin(middle)
        theta = middle + half
    return RobotState(x, y, theta, v, w)
