"""Options that several commands share: the same names everywhere."""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import click
import numpy as np

from adp_path_follower.core.errors import FileError
from adp_path_follower.core.files import output_to, read_csv_columns
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.library import PATH_HELP
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.study.simulation.simulate import PAPER_START
from sim_unicycle.settings import SimulatorSettings

Command = TypeVar("Command", bound=Callable[..., Any])

FILE = click.Path(path_type=Path)

_TOPICS = {"odom": "odom", "cmd": "cmd_vel", "path": "path"}  # option -> what a topic is read as


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


def simulator_options(command: Command) -> Command:
    """Add --sim-params and --sim-set."""
    command = click.option(
        "--sim-set",
        "sim_assignments",
        metavar="NAME=VALUE",
        multiple=True,
        help="Change one parameter of the simulated robot, as in --sim-set velocity_lag=0.1 or "
        "--sim-set fault_script=push; may be given several times.",
    )(command)
    return click.option(
        "--sim-params",
        type=FILE,
        metavar="FILE",
        help="Parameter file with a section for unicycle_sim: how the simulated robot is.",
    )(command)


def load_simulator(file: Path | None, assignments: tuple[str, ...]) -> SimulatorSettings:
    """Return the simulator's settings of --sim-params and --sim-set.

    Raises:
        FileError: The file cannot be read.
        SettingsError: A setting is unknown, of the wrong type or out of range.

    """
    return load_settings(SimulatorSettings, "unicycle_sim", file, assignments)


def topic_options(command: Command) -> Command:
    """Add --odom, --cmd and --path, of which `given_topics` makes one mapping."""
    for name, what in (("path", "path"), ("cmd", "commands"), ("odom", "odometry")):
        key = _TOPICS[name]
        text = f"Topic of the {what} in the bag; any named '{key}' if not given."
        command = click.option(f"--{name}", metavar="TOPIC", help=text)(command)
    return command


def given_topics(**topics: str | None) -> dict[str, str]:
    """Return "odom", "cmd_vel" and "path" -> topic, of those options that were given."""
    return {_TOPICS[name]: topic for name, topic in topics.items() if topic is not None}


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


def start_options(command: Command) -> Command:
    """Add --start, --starts and --start-arc-length."""
    command = click.option(
        "--start-arc-length",
        type=float,
        default=0.0,
        show_default=True,
        help="Where on the path the virtual target starts [m].",
    )(command)
    command = click.option(
        "--starts",
        "starts_file",
        type=FILE,
        metavar="FILE.csv",
        help="Initial errors as a CSV file with the columns s,y,theta.",
    )(command)
    return click.option(
        "--start",
        "starts",
        type=(float, float, float),
        multiple=True,
        metavar="S Y THETA",
        help="Initial error to the virtual target [m, m, rad]; may be given several times. "
        "The paper's (-0.5 0.25 -0.5236) if there is none.",
    )(command)


def cluster_options(command: Command) -> Command:
    """Add --scheduler, --workers and --dry-run."""
    command = click.option(
        "--dry-run", is_flag=True, help="Say how many runs there are and how long they take."
    )(command)
    command = click.option(
        "--workers",
        type=click.IntRange(1, 1024),
        metavar="N",
        help="Number of processes on this machine; as many as it has cores if not given.",
    )(command)
    return click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Run on the Dask cluster of this scheduler, as in tcp://host:8786, instead of all "
        "cores of this machine.",
    )(command)


def collect_starts(
    starts: tuple[tuple[float, float, float], ...], starts_file: Path | None
) -> FloatArray:
    """Return the initial errors of --start and then of --starts, shape (B, 3).

    Raises:
        FileError: The file cannot be read.

    """
    errors = np.array(starts, dtype=float).reshape(-1, 3)
    if starts_file is not None:
        errors = np.vstack([errors, read_csv_columns(starts_file, ("s", "y", "theta"))])
    return errors if len(errors) else np.array([PAPER_START])


@contextlib.contextmanager
def progress_bar(label: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar to people, nothing to a log; yields what takes the fraction done."""
    if not sys.stderr.isatty():  # click would leave an empty line
        yield lambda fraction: None
        return
    with click.progressbar(length=1000, label=label, file=sys.stderr) as bar:

        def progress(fraction: float) -> None:
            bar.update(int(1000 * fraction) - bar.pos)

        yield progress
        progress(1.0)


def check_writable(*files: Path | None) -> None:
    """Refuse output files that cannot be written, before any work is done.

    Raises:
        FileError: A folder is missing or not writable, the file is a directory, or two are one.

    """
    given = [file for file in files if file is not None]
    for number, file in enumerate(given):
        if file.resolve() in [other.resolve() for other in given[:number]]:
            raise FileError(f"output {file} is given twice: give each output a file of its own")
        if file.is_dir():
            raise FileError(f"output {file} is a directory: give a file name")
        if not file.parent.is_dir():
            raise FileError(f"output {file}: there is no directory {file.parent}")
        if not os.access(file if file.exists() else file.parent, os.W_OK):
            raise FileError(f"output {file} cannot be written: permission denied")


def new_directory(directory: Path) -> Path:
    """Return an output directory, made if needed.

    Raises:
        FileError: It holds files already, or cannot be made.

    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if any(directory.iterdir()):
            raise FileError(f"output {directory} holds files already: give a new directory")
    except FileError:
        raise
    except (FileExistsError, NotADirectoryError):
        raise FileError(f"output {directory} is a file: give a directory") from None
    except OSError as error:
        raise FileError(f"output {directory} cannot be made: {error.strerror}") from None
    return directory


@contextlib.contextmanager
def output_directory(directory: Path, keep: bool = False) -> Iterator[Path]:
    """Make an output directory, and take back what the block has written if the block fails.

    Half a report is of no use, and the same command again would be refused because of it.

    Args:
        directory: Where the output goes: a new or empty directory.
        keep: Whether what was written before is of use; an empty directory never is.

    Raises:
        FileError: As `new_directory`, or something in it cannot be written.

    """
    was_there = os.path.lexists(directory)  # which no name is too long for
    new_directory(directory)
    try:
        with output_to(directory):
            yield directory
    except BaseException:
        with contextlib.suppress(OSError):
            for item in () if keep else directory.iterdir():  # it was empty
                shutil.rmtree(item) if item.is_dir() else item.unlink()
            if not was_there:
                directory.rmdir()
        raise


def write_json(file: Path, content: object) -> None:
    """Write JSON with null for numbers that are not finite, which JSON does not know.

    Raises:
        FileError: It cannot be written.

    """
    text = json.dumps(_finite(content), indent=2, allow_nan=False)
    with output_to(file):  # in place: it may be no file but /dev/stdout
        file.write_text(text + "\n", encoding="utf-8")


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content
