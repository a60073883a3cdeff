"""Settings of the simulator."""

from __future__ import annotations

import math
from dataclasses import dataclass

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.schema import setting

_WIRING = "the node's topics and timers are made from it"
_START = "it is where the run starts; call ~/reset to start again"


@dataclass(frozen=True)
class StartSettings:
    """Start."""

    x: float = setting(0.0, "Initial x.", unit="m", low=-1e6, high=1e6, read_only=_START)
    y: float = setting(0.0, "Initial y.", unit="m", low=-1e6, high=1e6, read_only=_START)
    theta: float = setting(
        0.0, "Initial heading.", unit="rad", low=-1e3, high=1e3, read_only=_START
    )


@dataclass(frozen=True)
class PlantSettings:
    """Robot."""

    min_linear_vel: float = setting(
        -math.inf, "Lowest linear velocity that the robot can do.", unit="m/s", high=0.0
    )
    max_linear_vel: float = setting(
        math.inf, "Highest linear velocity that the robot can do.", unit="m/s", low=0.0
    )
    max_angular_vel: float = setting(
        math.inf, "Highest angular velocity that the robot can do.", unit="rad/s", low=0.0
    )
    velocity_lag: float = setting(
        0.0,
        "Time constant with which the velocities follow the command.",
        unit="s",
        low=0.0,
        high=10.0,
    )
    command_delay: float = setting(
        0.0, "Time from a command to its effect.", unit="s", low=0.0, high=10.0
    )
    position_noise: float = setting(
        0.0, "Standard deviation of the noise of x and y in odometry.", unit="m", low=0.0, high=10.0
    )
    heading_noise: float = setting(
        0.0,
        "Standard deviation of the noise of the heading in odometry.",
        unit="rad",
        low=0.0,
        high=3.0,
    )
    seed: int = setting(0, "Seed of the noise.", low=0, high=2**31 - 1, read_only=_START)


@dataclass(frozen=True)
class SimulationSettings:
    """Simulator node."""

    rate: float = setting(
        100.0,
        "Odometry messages per simulated second.",
        unit="Hz",
        low=1.0,
        high=1000.0,
        read_only=_WIRING,
    )
    real_time_factor: float = setting(
        1.0,
        "Simulated seconds per second; without effect in lock-step.",
        low=0.01,
        high=100.0,
        read_only=_WIRING,
    )
    lockstep: bool = setting(
        False,
        "Let simulated time go on only when the command that answers the last odometry has come: "
        "as fast as the machine can, and the same on every machine. The controller needs "
        "control_trigger: odometry.",
        read_only=_WIRING,
    )
    publish_clock: bool = setting(False, "Publish the simulated time on /clock.", read_only=_WIRING)
    duration: float = setting(
        math.inf,
        "Simulated time after which the node ends.",
        unit="s",
        low=0.01,
        read_only=_WIRING,
    )
    command_timeout: float = setting(
        0.5,
        "Age of the last command, in simulated time, after which the robot stands still.",
        unit="s",
        low=0.01,
        high=60.0,
    )
    odom_frame: str = setting("odom", "Frame of the odometry.", read_only=_WIRING)
    base_frame: str = setting("base_link", "Frame of the robot.", read_only=_WIRING)

    def __post_init__(self) -> None:
        """Refuse a pace that nobody else would know of."""
        if self.real_time_factor != 1.0 and not (self.publish_clock or self.lockstep):
            raise SettingsError(
                f"setting 'real_time_factor' is {self.real_time_factor:g}, but must be 1 unless "
                "publish_clock is true: other nodes could not follow"
            )


@dataclass(frozen=True)
class SimulatorSettings:
    """All settings of the simulator; build them with `schema.build(SimulatorSettings, values)`."""

    start: StartSettings
    plant: PlantSettings
    simulation: SimulationSettings
