"""The origin of a recording: host, versions, settings and the workspace's revision."""

from __future__ import annotations

import os
import platform
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path as FilePath

from adp_path_follower import __version__
from adp_path_follower.core.settings.schema import flatten, yaml_text

_REVISION = re.compile(r"[0-9a-f]{40}|[0-9a-f]{64}")


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
    """Return the commit that the repository around a directory stands at, empty without one.

    Its files are read, as git itself need not be installed where a robot records.
    """
    try:
        inner = directory.resolve()
        for folder in (inner, *inner.parents):
            if (folder / ".git").exists():
                return _head(folder / ".git")
    except (OSError, UnicodeDecodeError):
        return ""
    return ""


def _head(entry: FilePath) -> str:
    """Return the commit of HEAD; `entry` is a folder, or a file that names it (worktrees)."""
    folder = entry
    if entry.is_file():
        folder = entry.parent / entry.read_text(encoding="utf-8").removeprefix("gitdir:").strip()
    common = folder / "commondir"
    shared = folder / common.read_text(encoding="utf-8").strip() if common.is_file() else folder
    text = (folder / "HEAD").read_text(encoding="utf-8").strip()
    if not text.startswith("ref:"):
        return _commit(text)
    reference = text.removeprefix("ref:").strip()
    for place in (folder, shared):
        if (place / reference).is_file():
            return _commit((place / reference).read_text(encoding="utf-8").strip())
    packed = shared / "packed-refs"
    lines = packed.read_text(encoding="utf-8").splitlines() if packed.is_file() else []
    found = [line.split()[0] for line in lines if line.endswith(f" {reference}")]
    return _commit(found[0]) if found else ""


def _commit(text: str) -> str:
    return text if _REVISION.fullmatch(text) else ""


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
