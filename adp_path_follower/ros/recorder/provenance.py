"""The origin of a recording: host, versions, settings and the workspace's revision."""

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path as FilePath

from adp_path_follower import __version__
from adp_path_follower.core.settings.schema import flatten, yaml_text


def provenance(settings: object) -> dict[str, str]:
    """Return the entries of metadata.yaml on a recording's origin, with the recorder's settings."""
    found = {
        "host": platform.node(),
        "adp_path_follower": __version__,
        "python": platform.python_version(),
        **{name: found for name in ("numpy", "rclpy") if (found := _version(name))},
    }
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


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
