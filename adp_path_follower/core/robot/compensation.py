"""Commands for which the robot moves as an ideal unicycle would.

    v_c = v_a + (v_h - v_a) / (1 - exp(-h / lag))

acts from now + delay on, and within a horizon h brings the wheels from v_a to the wanted v_h. With
h far below the lag it inverts the lag with every error of the estimate; far above, it waits for the
lag. The controller is asked for the pose at now + delay + h.
"""

import math

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.model import RobotModel

_SHARE = 0.5  # of the lag
_SHORTEST = 0.03  # [s]
_NO_LAG = 0.004  # [s]
_PER_NOISE = 0.0


def horizon(model: RobotModel, noise: float) -> float:
    """Return h [s], longer with the noise [rad/s] of the turn rate that the controller asks for."""
    lag = max(model.linear_lag, model.angular_lag)
    if lag <= _NO_LAG:
        return 0.0
    return max(_SHORTEST, _SHARE * lag, min(lag, _PER_NOISE * noise))


def compensated(
    model: RobotModel, acting: tuple[float, float], wanted: FloatArray, ahead: float
) -> FloatArray:
    """Return the command (2,) from the wheels' v_a, w_a to a wanted motion V, W (2,) in h [s]."""
    v, w = model.wheels(*wanted.tolist())
    return np.array(
        [
            _inverted(acting[0], v, ahead, model.linear_lag),
            _inverted(acting[1], w, ahead, model.angular_lag),
        ]
    )


def _inverted(now: float, wanted: float, ahead: float, lag: float) -> float:
    """Return the command that brings a wheel velocity to the wanted one within a time [s]."""
    if lag <= _NO_LAG or ahead <= 0.0:
        return wanted
    return now + (wanted - now) / -math.expm1(-ahead / lag)
