"""Options that several commands share: the same names everywhere."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from adp_path_follower.core.errors import FileError
from adp_path_follower.core.path_library import PATH_HELP

Command = TypeVar("Command", bound=Callable[..., Any])

FILE = click.Path(path_type=Path)


def settings_options(command: Command) -> Command:
    """Add --params and --set."""
    command = click.option(
        "--set",
        "assignments",
        metavar="NAME=VALUE",
        multiple=True,
        help="Change one parameter; may be given several times, as in --set max_linear_vel=.inf.",
    )(command)
    return click.option(
        "--params",
        type=FILE,
        metavar="FILE",
        help="Parameter file: what `ros2 run ... --params-file` takes.",
    )(command)


def path_option(command: Command) -> Command:
    """Add --path."""
    return click.option(
        "--path",
        "path_name",
        default="lissajous",
        show_default=True,
        metavar="NAME|FILE",
        help=f"Path to follow: {PATH_HELP}.",
    )(command)


def check_writable(*files: Path | None) -> None:
    """Refuse output files that cannot be written, before any work is done.

    Raises:
        FileError: A folder is missing or not writable, or the file is a directory.

    """
    for file in files:
        if file is None:
            continue
        if file.is_dir():
            raise FileError(f"output {file} is a directory: give a file name")
        if not file.parent.is_dir():
            raise FileError(f"output {file}: there is no directory {file.parent}")
        if not os.access(file if file.exists() else file.parent, os.W_OK):
            raise FileError(f"output {file} cannot be written: permission denied")


def write_json(file: Path, content: object) -> None:
    """Write JSON with null for numbers that are not finite, which JSON does not know."""
    text = json.dumps(_finite(content), indent=2, allow_nan=False)
    file.write_text(text + "\n", encoding="utf-8")


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content
