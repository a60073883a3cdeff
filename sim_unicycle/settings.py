"""Settings of the simulator, and robots by name: those of config/robots, with their sources."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.robot.model import RobotModel
from adp_path_follower.core.settings.parameter_file import read_parameters
from adp_path_follower.core.settings.robot import bias_setting, gains_setting
from adp_path_follower.core.settings.schema import POSITIVE, build, limit, setting
from adp_path_follower.resources import shipped_file

_WIRING = "the node's topics and timers are made from it"
_START = "it is where the run starts; call ~/reset to start again"


def _imperfection(doc: str, **spec: Any) -> Any:
    """Declare a property that an ideal robot has none of."""
    return setting(0.0, doc, low=0.0, **spec)


def _offset(default: Any, doc: str, most: float, **spec: Any) -> Any:
    """Declare a number, or several, that may be as large to either side."""
    return setting(default, doc, low=-most, high=most, **spec)


@dataclass(frozen=True)
class StartSettings:
    """Start."""

    x: float = _offset(0.0, "Initial x.", most=1e6, unit="m", read_only=_START)
    y: float = _offset(0.0, "Initial y.", most=1e6, unit="m", read_only=_START)
    theta: float = _offset(0.0, "Initial heading.", most=1e3, unit="rad", read_only=_START)


@dataclass(frozen=True)
class PlantSettings:
    """Robot."""

    robot: str = setting(
        "",
        "Robot of config/robots, or a file like those: its values are the defaults of all others.",
        read_only="it is read at the start",
    )
    min_linear_vel: float = setting(
        -math.inf, "Lowest possible linear velocity.", unit="m/s", high=0.0
    )
    max_linear_vel: float = setting(
        math.inf, "Highest possible linear velocity.", unit="m/s", low=0.0
    )
    max_angular_vel: float = setting(
        math.inf, "Highest possible angular velocity.", unit="rad/s", low=0.0
    )
    max_linear_accel: float = limit("Highest possible linear acceleration.", unit="m/s^2")
    max_angular_accel: float = limit("Highest possible angular acceleration.", unit="rad/s^2")
    command_ramps: tuple[float, float] = setting(
        (math.inf, math.inf),
        "Highest changes of the commanded velocities that the firmware lets through.",
        unit="m/s^2, rad/s^2",
        low=POSITIVE,
    )
    velocity_lag: float = _imperfection(
        "Time constant of the wheels' velocities.", unit="s", high=10.0
    )
    angular_lag: float = setting(
        -1.0,
        "Time constant of the turn rate; that of velocity_lag if negative.",
        unit="s",
        low=-1.0,
        high=10.0,
    )
    command_delay: float = _imperfection(
        "Time from a command to its effect, rounded up to whole steps.", unit="s", high=10.0
    )
    gains: tuple[float, float] = gains_setting("those that the encoders report")
    bias: float = bias_setting()
    linear_slip: float = _imperfection(
        "Lost share of the wheels' linear velocity; odometry reports the wheels' velocity.",
        high=1.0,
    )
    angular_slip: float = _imperfection("Lost share of the wheels' angular velocity.", high=1.0)
    friction: float = limit(
        "Coefficient of friction: bounds the acceleration, along and across, to this times "
        "9.81 m/s^2. With little of it the robot brakes late and drifts wide."
    )
    push: tuple[float, float, float] = _offset(
        (0.0, 0.0, 0.0),
        "Velocity of a push, added to that of the wheels: forward, to the left and turning.",
        most=100.0,
        unit="m/s, m/s, rad/s",
    )
    position_noise: float = _imperfection(
        "Standard deviation of x and y in odometry.", unit="m", high=10.0
    )
    heading_noise: float = _imperfection(
        "Standard deviation of the heading in odometry.", unit="rad", high=3.0
    )
    encoder_noise: tuple[float, float] = setting(
        (0.0, 0.0),
        "Standard deviations of the linear and the angular velocity in odometry.",
        unit="m/s, rad/s",
        low=0.0,
        high=10.0,
    )
    dead_reckoning: bool = setting(
        False, "Integrate the encoders to the pose in odometry, instead of localising the robot."
    )
    position_drift: float = _imperfection(
        "Drift of x and y in odometry: a random walk with this standard deviation after 1 s.",
        unit="m/sqrt(s)",
        high=10.0,
    )
    heading_drift: float = _imperfection("The same for the heading.", unit="rad/sqrt(s)", high=3.0)
    odometry_rate: float = setting(
        math.inf, "Odometry messages per second, at most one for each step.", unit="Hz", low=0.1
    )
    odometry_delay: float = _imperfection(
        "Time from a measurement to its message, rounded up to whole steps. The stamp is that of "
        "the measurement.",
        unit="s",
        high=10.0,
    )
    odometry_jitter: float = _imperfection(
        "Standard deviation of this time; messages keep their order.", unit="s", high=1.0
    )
    odometry_drop: float = _imperfection("Probability that an odometry message is lost.", high=1.0)
    seed: int = setting(
        0,
        "Seed of all random numbers; run n of a batch has this seed plus n.",
        low=0,
        high=2**31 - 1,
        read_only=_START,
    )

    @property
    def ideal(self) -> bool:
        """Return whether this is the ideal unicycle with ideal odometry."""
        return replace(self, robot="", seed=0) == PlantSettings()

    @property
    def model(self) -> RobotModel:
        """Return the model of this robot."""
        return RobotModel(
            delay=self.command_delay,
            linear_lag=self.velocity_lag,
            angular_lag=self.velocity_lag if self.angular_lag < 0.0 else self.angular_lag,
            ramp=self.command_ramps[0],
            angular_ramp=self.command_ramps[1],
            linear_gain=self.gains[0],
            angular_gain=self.gains[1],
            bias=self.bias,
        )


@dataclass(frozen=True)
class MessageFaultSettings:
    """Faulty messages."""

    odometry_duplicate: float = _imperfection(
        "Probability that an odometry message is sent twice.", high=1.0
    )
    odometry_corruption: str = setting(
        "none",
        "Fault in the values of odometry messages.",
        choices=("none", "nan", "infinite", "zero_quaternion"),
    )
    odometry_offset: tuple[float, float, float] = _offset(
        (0.0, 0.0, 0.0),
        "Offset of x, y and theta in odometry messages: a pose that jumps.",
        most=1e6,
        unit="m, m, rad",
    )
    odometry_stamp_offset: float = _offset(
        0.0, "Offset of the stamps of odometry messages.", most=1e6, unit="s"
    )
    reported_odom_frame: str = setting("", "Frame in odometry messages; empty: odom_frame.")
    reported_base_frame: str = setting("", "Robot frame in odometry messages; empty: base_frame.")
    clock_stops: bool = setting(False, "Publish odometry, but no /clock.")
    clock_offset: float = _offset(
        0.0,
        "Offset of /clock and of odometry stamps; their time stays above 0.",
        most=1e6,
        unit="s",
    )


_wired = functools.partial(setting, read_only=_WIRING)


@dataclass(frozen=True)
class SimulationSettings:
    """Simulator node."""

    rate: float = _wired(
        100.0,
        "Steps per simulated second, each with one odometry message unless odometry_rate is lower.",
        unit="Hz",
        low=1.0,
        high=1000.0,
    )
    real_time_factor: float = _wired(
        1.0, "Simulated seconds per second; without effect in lock-step.", low=0.01, high=100.0
    )
    lockstep: bool = _wired(
        False,
        "Let simulated time wait for the command that answers the last odometry: fast, and the "
        "same on every machine. The controller needs control_trigger: odometry.",
    )
    publish_clock: bool = _wired(False, "Publish the simulated time on /clock.")
    duration: float = _wired(
        math.inf, "Simulated time after which the node ends.", unit="s", low=0.01
    )
    command_timeout: float = setting(
        0.5,
        "Age of the last command, in simulated time, at which the robot stops.",
        unit="s",
        low=0.01,
        high=60.0,
    )
    fault_script: str = setting(
        "",
        "Script of timed parameters: a file, or the name of one in config/faults.",
        read_only="it is read at the start",
    )

    def __post_init__(self) -> None:
        """Reject a pace that other nodes could not follow."""
        if self.real_time_factor != 1.0 and not (self.publish_clock or self.lockstep):
            raise SettingsError(
                f"setting 'real_time_factor' is {self.real_time_factor:g}, but must be 1 unless "
                "publish_clock is true: other nodes could not follow"
            )


@dataclass(frozen=True)
class FrameSettings:
    """Frames."""

    odom_frame: str = _wired("odom", "Frame of the odometry.")
    base_frame: str = _wired("base_link", "Frame of the robot.")
    map_frame: str = _wired("map", "Frame that odometry's has a place in; empty for none.")
    publish_tf: bool = _wired(True, "Publish transforms on /tf, where tf2_msgs is installed.")
    map_offset: tuple[float, float, float] = _offset(
        (0.0, 0.0, 0.0),
        "Place x, y, theta of odometry's frame in the map; a localisation that jumps changes it.",
        most=1e6,
        unit="m, m, rad",
    )
    map_drift: tuple[float, float, float] = _offset(
        (0.0, 0.0, 0.0),
        "Rate at which that place changes from the start on, as odometry drifts.",
        most=100.0,
        unit="m/s, m/s, rad/s",
    )


@dataclass(frozen=True)
class SimulatorSettings:
    """All settings of the simulator; build them with `schema.build(SimulatorSettings, values)`."""

    start: StartSettings = StartSettings()
    plant: PlantSettings = PlantSettings()
    message_faults: MessageFaultSettings = MessageFaultSettings()
    simulation: SimulationSettings = SimulationSettings()
    frames: FrameSettings = FrameSettings()

    def __post_init__(self) -> None:
        """Reject faulty messages in lock-step, which waits for an answer to each message."""
        if not self.simulation.lockstep:
            return
        for item in fields(MessageFaultSettings):
            value = getattr(self.message_faults, item.name)
            if value != item.default:
                raise SettingsError(
                    f"setting '{item.name}' is {value!r}, but lock-step waits for an answer to "
                    "every odometry message: set lockstep to false, or leave the messages alone"
                )


def with_robot(values: Mapping[str, object]) -> dict[str, object]:
    """Return the parameters of the robot that 'robot' names, changed by the given ones.

    Raises FileError if there is no such robot.
    """
    name = values.get("robot")
    if not name:
        return dict(values)
    return {**read_parameters(shipped_file("robots", str(name), "robot"), "unicycle_sim"), **values}


def simulator_settings(values: Mapping[str, object]) -> SimulatorSettings:
    """Return the simulator's settings; AdpError for a robot or value that there is not."""
    return build(SimulatorSettings, with_robot(values))
