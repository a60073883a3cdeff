"""Settings of the simulator, and robots by name: those of config/robots, with their sources."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.robot.model import RobotModel
from adp_path_follower.core.settings.parameter_file import read_parameters
from adp_path_follower.core.settings.robot import bias_setting, gains_setting
from adp_path_follower.core.settings.schema import POSITIVE, build, setting
from adp_path_follower.resources import shipped_file

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
    max_linear_accel: float = setting(
        math.inf, "Highest possible linear acceleration.", unit="m/s^2", low=POSITIVE
    )
    max_angular_accel: float = setting(
        math.inf, "Highest possible angular acceleration.", unit="rad/s^2", low=POSITIVE
    )
    command_ramps: tuple[float, ...] = setting(
        (math.inf, math.inf),
        "Highest changes of the commanded velocities that the firmware lets through.",
        unit="m/s^2, rad/s^2",
        low=POSITIVE,
        lengths=(2,),
    )
    velocity_lag: float = setting(
        0.0,
        "Time constant of the wheels' velocities.",
        unit="s",
        low=0.0,
        high=10.0,
    )
    angular_lag: float = setting(
        -1.0,
        "Time constant of the turn rate; that of velocity_lag if negative.",
        unit="s",
        low=-1.0,
        high=10.0,
    )
    command_delay: float = setting(
        0.0,
        "Time from a command to its effect, rounded up to whole steps.",
        unit="s",
        low=0.0,
        high=10.0,
    )
    gains: tuple[float, ...] = gains_setting("those that the encoders report")
    bias: float = bias_setting()
    linear_slip: float = setting(
        0.0,
        "Lost share of the wheels' linear velocity; odometry reports the wheels' velocity.",
        low=0.0,
        high=1.0,
    )
    angular_slip: float = setting(
        0.0, "Lost share of the wheels' angular velocity.", low=0.0, high=1.0
    )
    friction: float = setting(
        math.inf,
        "Coefficient of friction: bounds the acceleration, along and across, to this times "
        "9.81 m/s^2. With little of it the robot brakes late and drifts wide.",
        low=POSITIVE,
    )
    push: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0),
        "Velocity of a push, added to that of the wheels: forward, to the left and turning.",
        unit="m/s, m/s, rad/s",
        low=-100.0,
        high=100.0,
        lengths=(3,),
    )
    position_noise: float = setting(
        0.0, "Standard deviation of x and y in odometry.", unit="m", low=0.0, high=10.0
    )
    heading_noise: float = setting(
        0.0, "Standard deviation of the heading in odometry.", unit="rad", low=0.0, high=3.0
    )
    encoder_noise: tuple[float, ...] = setting(
        (0.0, 0.0),
        "Standard deviations of the linear and the angular velocity in odometry.",
        unit="m/s, rad/s",
        low=0.0,
        high=10.0,
        lengths=(2,),
    )
    dead_reckoning: bool = setting(
        False, "Integrate the encoders to the pose in odometry, instead of localising the robot."
    )
    position_drift: float = setting(
        0.0,
        "Drift of x and y in odometry: a random walk with this standard deviation after 1 s.",
        unit="m/sqrt(s)",
        low=0.0,
        high=10.0,
    )
    heading_drift: float = setting(
        0.0, "The same for the heading.", unit="rad/sqrt(s)", low=0.0, high=3.0
    )
    odometry_rate: float = setting(
        math.inf,
        "Odometry messages per second, at most one for each step.",
        unit="Hz",
        low=0.1,
    )
    odometry_delay: float = setting(
        0.0,
        "Time from a measurement to its message, rounded up to whole steps. The stamp is that of "
        "the measurement.",
        unit="s",
        low=0.0,
        high=10.0,
    )
    odometry_jitter: float = setting(
        0.0,
        "Standard deviation of this time; messages keep their order.",
        unit="s",
        low=0.0,
        high=1.0,
    )
    odometry_drop: float = setting(
        0.0, "Probability that an odometry message is lost.", low=0.0, high=1.0
    )
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

    odometry_duplicate: float = setting(
        0.0, "Probability that an odometry message is sent twice.", low=0.0, high=1.0
    )
    odometry_corruption: str = setting(
        "none",
        "Fault in the values of odometry messages.",
        choices=("none", "nan", "infinite", "zero_quaternion"),
    )
    odometry_offset: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0),
        "Offset of x, y and theta in odometry messages: a pose that jumps.",
        unit="m, m, rad",
        low=-1e6,
        high=1e6,
        lengths=(3,),
    )
    odometry_stamp_offset: float = setting(
        0.0, "Offset of the stamps of odometry messages.", unit="s", low=-1e6, high=1e6
    )
    reported_odom_frame: str = setting("", "Frame in odometry messages; empty: odom_frame.")
    reported_base_frame: str = setting("", "Robot frame in odometry messages; empty: base_frame.")
    clock_stops: bool = setting(False, "Publish odometry, but no /clock.")
    clock_offset: float = setting(
        0.0,
        "Offset of /clock and of odometry stamps; their time stays above 0.",
        unit="s",
        low=-1e6,
        high=1e6,
    )


@dataclass(frozen=True)
class SimulationSettings:
    """Simulator node."""

    rate: float = setting(
        100.0,
        "Steps per simulated second, each with one odometry message unless odometry_rate is lower.",
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
        "Let simulated time wait for the command that answers the last odometry: fast, and the "
        "same on every machine. The controller needs control_trigger: odometry.",
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

    odom_frame: str = setting("odom", "Frame of the odometry.", read_only=_WIRING)
    base_frame: str = setting("base_link", "Frame of the robot.", read_only=_WIRING)
    map_frame: str = setting(
        "map", "Frame that odometry's has a place in; empty for none.", read_only=_WIRING
    )
    publish_tf: bool = setting(
        True, "Publish transforms on /tf, where tf2_msgs is installed.", read_only=_WIRING
    )
    map_offset: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0),
        "Place x, y, theta of odometry's frame in the map; a localisation that jumps changes it.",
        unit="m, m, rad",
        low=-1e6,
        high=1e6,
        lengths=(3,),
    )
    map_drift: tuple[float, ...] = setting(
        (0.0, 0.0, 0.0),
        "Rate at which that place changes from the start on, as odometry drifts.",
        unit="m/s, m/s, rad/s",
        low=-100.0,
        high=100.0,
        lengths=(3,),
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
