"""The settings of the robot's model."""

import math
from dataclasses import dataclass

from adp_path_follower.core.settings.schema import POSITIVE, setting

ROBOT_MODELS = ("ideal", "given", "learned")


@dataclass(frozen=True)
class RobotSettings:
    """Robot."""

    robot_model: str = setting(
        "ideal",
        "The robot that commands are for: an ideal unicycle (with actuation_delay), the one that "
        "the next settings describe, or one that is learned while driving, from them on.",
        choices=ROBOT_MODELS,
    )
    robot_lags: tuple[float, ...] = setting(
        (0.0, 0.0),
        "Time constants with which the linear and the angular velocity follow their commands.",
        unit="s",
        low=0.0,
        high=2.0,
        lengths=(2,),
    )
    robot_ramp: float = setting(
        math.inf,
        "Highest linear acceleration that the robot's own firmware lets through.",
        unit="m/s²",
        low=POSITIVE,
    )
    robot_gains: tuple[float, ...] = setting(
        (1.0, 1.0),
        "True linear and angular velocity, as multiples of the commanded ones.",
        symbol="k_v, k_ω",
        low=0.5,
        high=2.0,
        lengths=(2,),
    )
    robot_bias: float = setting(
        0.0,
        "Turn that comes with each metre of driving straight, positive to the left.",
        symbol="b",
        unit="rad/m",
        low=-1.0,
        high=1.0,
    )
