"""The recorder's settings."""

from dataclasses import dataclass

from adp_path_follower.bags.bag_file import COMPRESSIONS
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.settings.schema import setting

RUN_TOPICS = (
    "odom",
    "ground_truth",
    "cmd_vel",
    "path",
    "path_follower/target",
    "path_follower/measured_pose",
    "path_follower/tracking_error",
    "path_follower/critic_weights",
    "path_follower/actor_weights",
    "path_follower/bellman_error",
    "path_follower/excitation",
    "path_follower/cost",
    "path_follower/configuration",
    "path_follower/initial_weights",
    "path_follower/status",
    "/diagnostics",
)

_FIXED = "the bag is made at the start"
_LEAST_DURATION, _LEAST_SIZE = 1.0, 100_000  # [s], [bytes]: smaller files are all index


@dataclass(frozen=True)
class TopicSettings:
    """Content of the recording."""

    topics: tuple[str, ...] = setting(
        RUN_TOPICS,
        "Topics to record as soon as they appear: names, or regular expressions for whole names.",
        read_only=_FIXED,
    )
    all: bool = setting(False, "Record every topic.", read_only=_FIXED)
    exclude: tuple[str, ...] = setting(
        (), "Topics not to record, whatever else is set: names or expressions.", read_only=_FIXED
    )


@dataclass(frozen=True)
class BagSettings:
    """Place and form of the recording."""

    output: str = setting(
        "",
        "Directory of the bag, which must not exist yet; empty makes one named by date and time.",
        read_only=_FIXED,
    )
    max_duration: float = setting(
        0.0,
        "Time after which the bag goes on in another file; 0 is never, else at least 1.",
        unit="s",
        low=0.0,
        high=1e9,
        read_only=_FIXED,
    )
    max_size: int = setting(
        0,
        "Length, without its index, that a file of the bag must not exceed; 0 is any, else at "
        "least 100000.",
        unit="bytes",
        low=0,
        high=2**62,
        read_only=_FIXED,
    )
    compression: str = setting(
        "none", "How messages are packed in the bag.", choices=COMPRESSIONS, read_only=_FIXED
    )

    def __post_init__(self) -> None:
        """Reject files that hold next to nothing."""
        if 0 < self.max_duration < _LEAST_DURATION:
            raise SettingsError(
                f"setting 'max_duration' is {self.max_duration!r}, but must be 0 or at least "
                f"{_LEAST_DURATION:g} [s]"
            )
        if 0 < self.max_size < _LEAST_SIZE:
            raise SettingsError(
                f"setting 'max_size' is {self.max_size!r}, but must be 0 or at least "
                f"{_LEAST_SIZE} [bytes]"
            )


@dataclass(frozen=True)
class RecorderSettings:
    """All settings of the recorder."""

    topics: TopicSettings
    bag: BagSettings
