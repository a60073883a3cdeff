"""The recorder's settings, and what metadata.yaml says of a recording's origin."""

import contextlib
import functools
import os
import platform
import re
import subprocess
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path as FilePath

from adp_path_follower import __version__
from adp_path_follower.bags.bag_file import COMPRESSIONS
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.settings.schema import flatten, setting, yaml_text
from adp_path_follower.messages.topics import RUN_TOPICS

_fixed = functools.partial(setting, read_only="the bag is made at the start")
_LEAST_DURATION, _LEAST_SIZE = 1.0, 100_000  # [s], [bytes]: smaller files are all index
_NAME = re.compile(r"[~/\w{}]+", re.ASCII)  # what is no topic name is a regular expression


@dataclass(frozen=True)
class TopicSettings:
    """Content of the recording."""

    topics: tuple[str, ...] = _fixed(
        RUN_TOPICS,
        "Topics to record as soon as they appear: names, or regular expressions for whole names.",
    )
    all: bool = _fixed(False, "Record every topic.")
    exclude: tuple[str, ...] = _fixed(
        (), "Topics not to record, whatever else is set: names or expressions."
    )


@dataclass(frozen=True)
class BagSettings:
    """Place and form of the recording."""

    output: str = _fixed(
        "",
        "Directory of the bag, which must not exist yet; empty makes one named by date and time.",
    )
    max_duration: float = _fixed(
        0.0,
        "Time after which the bag goes on in another file; 0 is never, else at least 1.",
        unit="s",
        low=0.0,
        high=1e9,
    )
    max_size: int = _fixed(
        0,
        "Length, without its index, that a file of the bag must not exceed; 0 is any, else at "
        "least 100000.",
        unit="bytes",
        low=0,
        high=2**62,
    )
    compression: str = _fixed("none", "How messages are packed in the bag.", choices=COMPRESSIONS)

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


def is_meant(patterns: Iterable[re.Pattern[str]], topic: str, namespace: str) -> bool:
    """Return whether all of a topic's name, full or in the namespace, matches one of patterns."""
    names = topic, topic.removeprefix(f"{namespace.rstrip('/')}/")
    return any(pattern.fullmatch(name) for pattern in patterns for name in names)


def topic_patterns(
    setting: str, texts: Sequence[str], resolve: Callable[[str], str]
) -> list[re.Pattern[str]]:
    """Return the patterns of the names and regular expressions that a setting lists.

    `resolve` returns a name's full one, after remapping. Raises SettingsError for any other text.
    """
    found = []
    for text in texts:
        try:
            if _NAME.fullmatch(text):
                found.append(re.compile(re.escape(_resolved(setting, text, resolve))))
            else:
                found.append(re.compile(text))
        except re.error as error:
            raise SettingsError(
                f"setting '{setting}' lists {text!r}, which is no regular expression: {error}; "
                "write a topic's name, or an expression like '/robot/.*'"
            ) from None
    return found


def _resolved(setting: str, name: str, resolve: Callable[[str], str]) -> str:
    try:
        return resolve(name)
    except Exception as error:  # rclpy has several types for names that ROS does not allow
        reason = " ".join(str(error).split()).split(", at ")[0]
        raise SettingsError(
            f"setting '{setting}' lists {name!r}, which is no topic name: {reason}"
        ) from None


def provenance(settings: object) -> dict[str, str]:
    """Return the entries of metadata.yaml on a recording's origin, with the recorder's settings."""
    found = {
        "host": platform.node(),
        "adp_path_follower": __version__,
        "python": platform.python_version(),
    }
    for name in ("numpy", "rclpy"):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    if distribution := os.environ.get("ROS_DISTRO"):
        found["ros_distro"] = distribution
    if revision := git_revision(FilePath()):
        found["git_revision"] = revision
    values = flatten(settings)
    return found | {f"recorder.{name}": yaml_text(value) for name, value in values.items()}


def git_revision(directory: FilePath) -> str:
    """Return the commit of the git repository around a directory, empty without one."""
    command = ["git", "-c", "safe.directory=*", "-C", str(directory), "rev-parse", "HEAD"]
    try:
        done = subprocess.run(  # noqa: S603  # git, with our own arguments
            command, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()
