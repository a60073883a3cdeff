"""Commands for which the robot moves as an ideal unicycle would.

With commands v_c = v + (V - v) lag / tau the wheels follow the wanted V by a lag tau of our choice.
Then x + tau x', y + tau y', theta + tau theta' move as an ideal unicycle that is told V and W: the
controller is asked for that pose, at now + delay + tau. A tau below the lag inverts the lag with
every error of the estimate; tau = lag waits for it. Commands change no faster than the firmware's
ramps let them: a speed that runs ahead of its ramp leaves no room for a turn.
"""

import math

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.model import RobotModel, RobotState, advanced

_SHARE = 0.25  # of the lag
_SHORTEST = 0.04  # [s]
_NO_LAG = 0.004  # [s]


def lag_left(model: RobotModel) -> float:
    """Return tau [s]."""
    lag = max(model.linear_lag, model.angular_lag)
    return max(min(_SHORTEST, lag), _SHARE * lag) if lag > _NO_LAG else 0.0


def ideal_state(model: RobotModel, acting: RobotState, lag: float) -> RobotState:
    """Return the pose that moves as an ideal unicycle, with a lag tau [s] of the wheels."""
    if lag <= 0.0:
        return acting
    return advanced(model, acting, [(acting.v, acting.w, lag)])


def compensated(
    model: RobotModel, acting: RobotState, wanted: FloatArray, lag: float, period: float
) -> FloatArray:
    """Return the command (2,) for a wanted motion V, W (2,), which is held for a period [s]."""
    v, w = model.wheels(*wanted.tolist())
    if lag <= 0.0:
        return np.array([v, w])
    share = -math.expm1(-period / lag)
    return np.array(
        [
            acting.v + share * (v - acting.v) / _answer(period, model.linear_lag),
            acting.w + share * (w - acting.w) / _answer(period, model.angular_lag),
        ]
    )


def let_through(
    model: RobotModel, command: FloatArray, reached: FloatArray, period: float
) -> FloatArray:
    """Return how far the ramps of the wheels let a command through in a period [s], (2,) each.

    Each wheel has one ramp for v and w, which therefore change in proportion.
    """
    change = command - reached
    time = abs(float(change[0])) / model.ramp + abs(float(change[1])) / model.angular_ramp
    return reached + change * (period / time) if time > period else command


def _answer(period: float, lag: float) -> float:
    """Return which share of a change of its command a wheel makes in a period [s]."""
    return -math.expm1(-period / lag) if lag > 0.0 else 1.0
