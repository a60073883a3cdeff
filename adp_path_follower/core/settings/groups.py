"""The controller's settings: the one place that names, types, bounds and explains them."""

import functools
import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.learning import LearningSettings, PolicySettings
from adp_path_follower.core.settings.navigation import NavigationSettings
from adp_path_follower.core.settings.robot import RobotSettings
from adp_path_follower.core.settings.schema import POSITIVE, limit, setting, update

FAST = 2.0  # [m/s]: the ways of faster robots are longer, in proportion to the speed
_WIRING = "the node's topics are made from it"
_TIMER = "the control timer is made from it"


def _matrix(name: str, values: tuple[float, ...], size: int) -> FloatArray:
    """Return a cost matrix given by its diagonal or row by row, shape (size, size)."""
    given = np.asarray(values)
    matrix = np.diag(given) if len(values) == size else given.reshape(size, size)
    if not np.all(np.isfinite(matrix)) or not np.array_equal(matrix, matrix.T):
        raise SettingsError(f"setting '{name}' is {list(values)}, but must be finite and symmetric")
    return matrix


@dataclass(frozen=True)
class TargetSettings:
    """Virtual target."""

    desired_speed: float = setting(
        0.5, "Speed along the path.", symbol="v_des", unit="m/s", low=POSITIVE, high=20.0
    )
    target_gain: float = setting(
        0.1,
        "How strongly the virtual target runs ahead of a robot that is ahead of it, and waits "
        "for one that is behind.",
        symbol="k1",
        unit="1/s",
        low=POSITIVE,
        high=100.0,
    )
    path_state_gain: float = setting(
        0.05,
        "Scale that maps arc length to the compact path state φ = tanh(k2 s_p).",
        symbol="k2",
        unit="1/m",
        low=POSITIVE,
        high=100.0,
    )


@dataclass(frozen=True)
class CostSettings:
    """Cost."""

    state_cost: tuple[float, ...] = setting(
        (1.0, 1.0, 1.0),
        "Weight of the errors [s, y, θ]: the diagonal, or all 9 entries row by row; symmetric, "
        "positive semidefinite.",
        symbol="Q",
        lengths=(3, 9),
    )
    input_cost: tuple[float, ...] = setting(
        (1.0, 1.0),
        "Weight of the inputs [v − v_ss, ω − ω_ss]: the diagonal, or all 4 entries row by row; "
        "symmetric, positive definite.",
        symbol="R",
        lengths=(2, 4),
    )

    def __post_init__(self) -> None:
        """Reject costs without a minimum."""
        eigenvalues = np.linalg.eigvalsh(self.state_cost_matrix())
        if eigenvalues[0] < -1e-12 * max(1.0, eigenvalues[-1]):  # zero, but for rounding
            raise SettingsError(
                f"setting 'state_cost' is {list(self.state_cost)}, but must be positive "
                "semidefinite: no eigenvalue below 0"
            )
        eigenvalues = np.linalg.eigvalsh(self.input_cost_matrix())
        if eigenvalues[0] <= 1e-12 * max(1.0, eigenvalues[-1]):  # no inverse in numbers, either
            raise SettingsError(
                f"setting 'input_cost' is {list(self.input_cost)}, but must be positive "
                "definite: every eigenvalue above 0"
            )

    def state_cost_matrix(self) -> FloatArray:
        """Return Q, shape (3, 3)."""
        return _matrix("state_cost", self.state_cost, 3)

    def input_cost_matrix(self) -> FloatArray:
        """Return R, shape (2, 2)."""
        return _matrix("input_cost", self.input_cost, 2)

    def inverse_input_cost(self) -> FloatArray:
        """Return R^-1, shape (2, 2)."""
        return np.asarray(np.linalg.inv(self.input_cost_matrix()), float)


@dataclass(frozen=True)
class LimitSettings:
    """Limits of the command."""

    min_linear_vel: float = setting(
        0.0, "Lowest linear velocity.", unit="m/s", high=0.0, symbol="v_min"
    )
    max_linear_vel: float = setting(
        1.0, "Highest linear velocity.", unit="m/s", low=POSITIVE, symbol="v_max"
    )
    max_angular_vel: float = setting(
        1.5,
        "Highest angular velocity, in either direction.",
        unit="rad/s",
        low=POSITIVE,
        symbol="ω_max",
    )

    speed_limit: float = limit(
        "Highest linear velocity for now, in either direction, as the topic speed_limit sets it.",
        unit="m/s",
    )

    @functools.cached_property
    def lower(self) -> FloatArray:
        """Return the lowest [v, w], shape (2,)."""
        return np.array([max(self.min_linear_vel, -self.speed_limit), -self.max_angular_vel])

    @functools.cached_property
    def upper(self) -> FloatArray:
        """Return the highest [v, w], shape (2,)."""
        return np.array([min(self.max_linear_vel, self.speed_limit), self.max_angular_vel])

    @functools.cached_property
    def unlimited(self) -> bool:
        """Return whether no command is ever clipped."""
        return not (np.isfinite(self.lower).any() or np.isfinite(self.upper).any())


_NO_LIMIT = ".inf is no limit."


@dataclass(frozen=True)
class MotionSettings:
    """Motion."""

    max_linear_accel: float = limit(
        f"Highest linear acceleration. {_NO_LIMIT}", unit="m/s²", symbol="a"
    )
    max_linear_decel: float = limit(
        "Highest linear deceleration; where it is finite, the robot brakes to the end of an open "
        f"path. {_NO_LIMIT}",
        unit="m/s²",
        symbol="d",
    )
    max_angular_accel: float = limit(
        f"Highest angular acceleration, in either direction. {_NO_LIMIT}",
        unit="rad/s²",
        symbol="α_max",
    )
    max_linear_jerk: float = limit(
        f"Highest rate of change of the linear acceleration. {_NO_LIMIT}", unit="m/s³"
    )
    max_angular_jerk: float = limit(
        f"Highest rate of change of the angular acceleration. {_NO_LIMIT}", unit="rad/s³"
    )
    max_lateral_accel: float = limit(
        f"Highest lateral acceleration v² κ of the speed along the path. {_NO_LIMIT}",
        unit="m/s²",
        symbol="a_lat",
    )
    xy_goal_tolerance: float = setting(
        0.05,
        "Distance from the end of an open path within which the goal is reached, if the robot "
        "brakes to it (max_linear_decel).",
        unit="m",
        low=POSITIVE,
    )
    yaw_goal_tolerance: float = setting(0.1, "The same for the heading.", unit="rad", low=POSITIVE)
    actuation_delay: float = setting(
        0.0,
        "Known time from a command to its effect, over which the pose is predicted; with "
        "robot_model: learned, the time to begin with.",
        unit="s",
        low=0.0,
        high=1.0,
    )

    @functools.cached_property
    def limited(self) -> bool:
        """Return whether a command may depend on the one before."""
        accelerations = self.max_linear_accel, self.max_linear_decel, self.max_angular_accel
        return self.jerk_limited or any(map(math.isfinite, accelerations))

    @functools.cached_property
    def jerk_limited(self) -> bool:
        """Return whether a jerk is limited."""
        return math.isfinite(self.max_linear_jerk) or math.isfinite(self.max_angular_jerk)


@dataclass(frozen=True)
class PathSettings:
    """Path preparation."""

    path_tolerance: float = setting(
        0.05,
        "How far the path that is driven may be from the poses given, and from the straight lines "
        "between them: room to average noise and to round corners. A path that is smooth is "
        "driven as it is. 0 always drives through the poses. Holds from the next path on.",
        unit="m",
        low=0.0,
        high=10.0,
    )
    path_closed: str = setting(
        "auto",
        "Whether a path's end joins its beginning: auto asks whether they coincide (1 mm). Holds "
        "from the next path on.",
        choices=("auto", "open", "closed"),
    )
    turn_at_goal: bool = setting(
        True,
        "Turn on the spot at the end of an open path to the heading of its last pose, within "
        "yaw_goal_tolerance. Poses without orientations, or only with the identity, ask for no "
        "turn. Holds from the next path on.",
    )
    allow_reversing: bool = setting(
        False,
        "Drive backwards where a path turns back on itself, or where the orientations of its poses "
        "point against the motion; false rejects such a path. Needs min_linear_vel below 0. Holds "
        "from the next path on.",
    )


@dataclass(frozen=True)
class ControllerSettings:
    """Controller node."""

    controller_frequency: float = setting(
        100.0,
        "Rate at which commands are published.",
        unit="Hz",
        low=1.0,
        high=1000.0,
        read_only=_TIMER,
    )
    control_trigger: str = setting(
        "timer",
        "Trigger of a control step: a timer at controller_frequency, or every odometry message "
        "(the lock-step simulation needs it).",
        choices=("timer", "odometry"),
        read_only=_TIMER,
    )
    debug_rate: float = limit(
        "Rate at which the debug topics tell what a control step found, while somebody subscribes; "
        ".inf tells it of every step, so that a recording is complete.",
        unit="Hz",
    )
    path_start: str = setting(
        "earliest",
        "Where on a new path the virtual target starts: at the earliest place among those that the "
        "robot's pose cannot tell apart (laps, lanes, the ends of a loop), at the beginning, at "
        "the place that fits the pose best, or at start_arc_length. After a stop, and on a path "
        "that only got other ends, it goes on where it was.",
        choices=("earliest", "beginning", "nearest", "arc_length"),
    )
    start_arc_length: float = setting(
        0.0, "Where new paths begin with path_start: arc_length.", unit="m", low=0.0
    )
    odom_timeout: float = setting(
        0.5,
        "Age of the odometry, in steady time, at which the robot is told to stop.",
        unit="s",
        low=0.01,
        high=60.0,
    )
    odom_jump_tolerance: float = setting(
        0.5,
        "How far odometry may be from where its velocity leads from one message to the next; "
        "beyond, the robot is told to stop. .inf allows any jump.",
        unit="m",
        low=POSITIVE,
    )
    max_cross_track_error: float = limit(
        "Distance from the path, sideways at the virtual target, at which the robot is told to "
        "stop until ~/resume is called.",
        unit="m",
    )
    max_heading_error: float = limit(
        "Heading error at which the robot is told to stop until ~/resume is called.", unit="rad"
    )
    enable_stamped_cmd_vel: bool = setting(
        True,
        "Publish geometry_msgs/TwistStamped; false publishes geometry_msgs/Twist.",
        read_only=_WIRING,
    )
    weights_file: str = setting(
        "",
        "File of learned weights to start from, which ~/save_weights wrote; empty starts from "
        "initial_weights.",
        read_only="it is read once, at the start",
    )
    save_weights_to: str = setting(
        "adp_weights.npz",
        "File that ~/save_weights writes, in the node's working directory unless it says where.",
    )
    autostart: bool = setting(
        True,
        "Configure and activate at once; false waits for the lifecycle transitions.",
        read_only="it only matters at the start",
    )


@dataclass(frozen=True)
class Settings:
    """All settings of the controller, as groups of values; `with_changes` gives others."""

    target: TargetSettings
    cost: CostSettings
    limits: LimitSettings
    motion: MotionSettings
    learning: LearningSettings
    policy: PolicySettings
    robot: RobotSettings
    path: PathSettings
    controller: ControllerSettings
    navigation: NavigationSettings

    def __post_init__(self) -> None:
        """Reject reversing without a speed for it."""
        if self.path.allow_reversing and self.limits.min_linear_vel >= 0.0:
            raise SettingsError(
                "setting 'allow_reversing' is true, but 'min_linear_vel' is 0: set it to the speed "
                "in reverse, as in -0.3"
            )

    @property
    def stretch(self) -> float:
        """Return by how much the lengths that count for fast robots exceed the usual ones."""
        return max(1.0, min(self.target.desired_speed, float(self.limits.upper[0])) / FAST)

    @property
    def half_widths(self) -> FloatArray:
        """Return the half-widths of the region of sampled s, y [m] and theta [rad], (3,)."""
        return np.array(self.learning.sample_half_widths[:3]) * [self.stretch, self.stretch, 1.0]

    def with_changes(self, **changes: object) -> "Settings":
        """Return settings with some values changed, checked like those of a file.

        Example: `settings.with_changes(desired_speed=0.3, max_linear_vel=0.6)`.

        Raises:
            SettingsError: A setting is unknown, of the wrong type or out of range.

        """
        return update(self, changes)
