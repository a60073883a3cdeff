"""Options that several commands share: the same names everywhere."""

import contextlib
import functools
import sys
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path as FilePath
from typing import Any, TypeVar

import click
import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.library import PATH_HELP
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.resources import FORTY_STARTS, parameter_file
from adp_path_follower.study.simulation.simulate import PAPER_START, read_starts
from sim_unicycle.settings import SimulatorSettings, with_robot

Command = TypeVar("Command", bound=Callable[..., Any])

FILE = click.Path(path_type=FilePath)
_FOUND = "any named '{}', or the only one of its type,"
# Option -> what a topic is read as, in words, and what holds without the option.
_TOPICS = {
    "odom": ("odom", "odometry", _FOUND.format("odom")),
    "cmd": ("cmd_vel", "commands", _FOUND.format("cmd_vel")),
    "path": ("path", "path", _FOUND.format("path")),
    "pose": ("ground_truth", "odometry with a localised pose", "the odometry"),
}


def file_option(
    option: str, name: str, text: str, metavar: str = "FILE"
) -> Callable[[Command], Command]:
    """Add an option for a file or a folder, which the command gets by a name."""
    return click.option(option, name, type=FILE, metavar=metavar, help=text)


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
        type=parameter_file,
        metavar="NAME|FILE",
        help="Parameters: default, paper, turtlebot4, diff_drive or late_robot, or a file such as "
        "`ros2 run ... --params-file` takes.",
    )(command)


def simulator_options(command: Command) -> Command:
    """Add --robot, --sim-params and --sim-set, which the command gets as `simulator`.

    Raises FileError or SettingsError for settings of the simulator that cannot be.
    """

    @functools.wraps(command)
    def simulating(
        robot: str | None,
        sim_params: FilePath | None,
        sim_assignments: tuple[str, ...],
        **options: Any,
    ) -> Any:
        named = () if robot is None else (f"robot={robot}",)
        settings = load_settings(
            SimulatorSettings, "unicycle_sim", sim_params, (*named, *sim_assignments), with_robot
        )
        return command(simulator=settings, **options)

    found = click.option(
        "--sim-set",
        "sim_assignments",
        metavar="NAME=VALUE",
        multiple=True,
        help="Change one parameter of the simulated robot, as in --sim-set velocity_lag=0.1 or "
        "--sim-set fault_script=push; may be given several times.",
    )(simulating)
    found = click.option(
        "--sim-params",
        type=parameter_file,
        metavar="FILE",
        help="Parameter file with a section for unicycle_sim: how the simulated robot is.",
    )(found)
    return click.option(
        "--robot",
        metavar="NAME|FILE",
        help="Simulate this robot: ideal, turtlebot4, turtlebot3_burger, turtlebot3_waffle_pi, "
        "jackal, husky or late, or a file that `adp identify` wrote.",
    )(found)  # type: ignore[return-value]  # click gives its wrapper the type of the wrapped


def topic_options(*names: str) -> Callable[[Command], Command]:
    """Add options such as --odom, --cmd and --path, of which `given_topics` makes one mapping."""

    def with_topics(command: Command) -> Command:
        for name in names:
            _, what, default = _TOPICS[name]
            text = f"Topic of the {what} in the bag; {default} if not given."
            command = click.option(f"--{name}", metavar="TOPIC", help=text)(command)
        return command

    return with_topics


def given_topics(**topics: str | None) -> dict[str, str]:
    """Return "odom", "cmd_vel" and others -> topic, of those options that were given."""
    return {_TOPICS[name][0]: topic for name, topic in topics.items() if topic is not None}


path_option = click.option(
    "--path",
    "path_name",
    default="lissajous",
    show_default=True,
    metavar="NAME|FILE",
    help=f"Path to follow: {PATH_HELP}.",
)


def start_options(command: Command) -> Command:
    """Add --start, --starts and --start-arc-length."""
    command = click.option(
        "--start-arc-length",
        type=float,
        default=0.0,
        show_default=True,
        help="Where on the path the virtual target starts [m].",
    )(command)
    text = "Initial errors: the reference's forty, or a CSV file with the columns s,y,theta."
    command = file_option("--starts", "starts_file", text, "forty|FILE.csv")(command)
    return click.option(
        "--start",
        "starts",
        type=(float, float, float),
        multiple=True,
        metavar="S Y THETA",
        help="Initial error to the virtual target [m, m, rad]; may be given several times. "
        "The paper's (-0.5 0.25 -0.5236) if there is none.",
    )(command)


def out_option(name: str, content: str) -> Callable[[Command], Command]:
    """Add --out: a new or empty directory, by default named after the command and the date."""
    return click.option(
        "--out",
        "directory",
        type=FILE,
        metavar="DIR",
        default=lambda: datetime.now().strftime(f"adp_{name}_%Y_%m_%d-%H_%M_%S"),
        help=f"Where {content} go: a new or empty directory (adp_{name}_DATE if it is not given).",
    )


def cluster_options(command: Command) -> Command:
    """Add --out, --scheduler, --workers and --dry-run."""
    command = click.option(
        "--dry-run", is_flag=True, help="Say how many runs there are and how long they take."
    )(command)
    command = click.option(
        "--workers",
        type=click.IntRange(1, 1024),
        metavar="N",
        help="Number of processes on this machine; as many as it has cores if not given.",
    )(command)
    command = click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Run on the Dask cluster of this scheduler, as in tcp://host:8786, instead of all "
        "cores of this machine.",
    )(command)
    text = "Where the results go: a new directory, or that of the same work, which then resumes."
    return file_option("--out", "directory", text, "DIR")(command)


def collect_starts(
    starts: tuple[tuple[float, float, float], ...], starts_file: FilePath | None
) -> FloatArray:
    """Return the initial errors of --start and --starts, shape (B, 3); may raise FileError."""
    errors = np.array(starts, dtype=float).reshape(-1, 3)
    if starts_file is not None:
        file = FORTY_STARTS if str(starts_file) == "forty" else starts_file
        errors = np.vstack([errors, read_starts(file)])
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
