"""The settings of the robot's model."""

import math
from dataclasses import dataclass
from typing import Any

from adp_path_follower.core.settings.schema import POSITIVE, setting

ROBOT_MODELS = ("ideal", "given", "learned")


def gains_setting(others: str) -> Any:
    """Declare k_v and k_w, the true velocities as multiples of others."""
    return setting(
        (1.0, 1.0),
        f"True linear and angular velocity, as multiples of {others}.",
        symbol="k_v, k_ω",
        low=0.5,
        high=2.0,
    )


def bias_setting() -> Any:
    """Declare the bias b of a robot."""
    return setting(
        0.0,
        "Turn that comes with each metre of driving straight, positive to the left.",
        symbol="b",
        unit="rad/m",
        low=-1.0,
        high=1.0,
    )


@dataclass(frozen=True)
class RobotSettings:
    """Robot."""

    robot_model: str = setting(
        "learned",
        "The robot that commands are for: an ideal unicycle (with actuation_delay), the one that "
        "the next settings describe, or one that is learned while driving, from them on.",
        choices=ROBOT_MODELS,
    )
    robot_lags: tuple[float, float] = setting(
        (0.0, 0.0),
        "Time constants with which the linear and the angular velocity follow their commands.",
        unit="s",
        low=0.0,
        high=2.0,
    )
    robot_ramps: tuple[float, float] = setting(
        (math.inf, math.inf),
        "Highest linear and angular acceleration that the robot's own firmware lets through.",
        unit="m/s², rad/s²",
        low=POSITIVE,
    )
    robot_gains: tuple[float, float] = gains_setting("the commanded ones")
    robot_bias: float = bias_setting()
