"""The functions of `import adp_path_follower as adp`: plain arguments in, results out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.errors import PathError
from adp_path_follower.core.files import expanded
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import named_path, path_through
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings as read_settings
from adp_path_follower.resources import parameter_file
from adp_path_follower.study.simulation.simulate import (
    PAPER_START,
    SimulationResult,
    checked_starts,
    read_starts,
)
from adp_path_follower.study.simulation.simulate import simulate as run_simulation
from sim_unicycle.fault_script import FaultScript, without_nodes
from sim_unicycle.settings import PlantSettings, simulator_settings

if TYPE_CHECKING:
    from adp_path_follower.analysis.bag_analysis import BagAnalysis
    from adp_path_follower.study.comparison.compare import Comparison
    from adp_path_follower.study.optimum.collocation import Optimum

PathLike = Path | str | FilePath | ArrayLike
SettingsLike = Settings | str | FilePath


def load_settings(source: str | FilePath = "default", **changes: object) -> Settings:
    """Return the controller's settings, checked.

    Example: `adp.load_settings("paper", actor_gain=2.0)`.

    Args:
        source: "default", "paper" or another file that comes with the package, or a YAML file.
        changes: Settings that differ from it.

    Raises:
        FileError: There is no such file.
        SettingsError: A setting is unknown, of the wrong type or out of range.

    """
    file = expanded(str(parameter_file(os.fspath(source))))
    return read_settings(Settings, "path_follower", file).with_changes(**changes)


def path(
    source: PathLike, *, closed: bool | None = None, settings: SettingsLike = "default"
) -> Path:
    """Return a path, prepared as the controller prepares it.

    Example: `adp.path([[0, 0], [3, 0], [5, 2]])`, `adp.path("circle:0.5")`, `adp.path("my.csv")`.

    Args:
        source: Points, shape (N, 2) [m]; or a name or a file, as `adp simulate --path` takes it.
        closed: Whether the last point joins the first; by default if they coincide.
        settings: Give the tolerance with which points are rounded.

    Raises:
        PathError: There is no such name, or the points make no path.
        FileError: The file is missing or of another format.

    """
    if isinstance(source, Path):
        return source
    prepared = _settings(settings).path
    if isinstance(source, str | FilePath):
        return named_path(str(source), prepared)
    try:
        points = np.asarray(source, dtype=float)
    except (TypeError, ValueError):
        raise PathError("path must be points [x, y], a name or a file") from None
    return path_through(points, closed, prepared)


def simulate(
    path: PathLike = "lissajous",
    settings: SettingsLike = "default",
    *,
    starts: ArrayLike = PAPER_START,
    start_arc_length: float = 0.0,
    duration: float = 30.0,
    rate: float = 100.0,
    learning: str = "cold",
    robot: Mapping[str, object] | str | None = None,
    record: bool = False,
) -> SimulationResult:
    """Simulate the closed loop without ROS, from one or many starts.

    Example: `adp.simulate([[0, 0], [9, 1]], starts=[[0, 0.5, 0], [0, -0.5, 0]], duration=10)`.

    Args:
        path: As for `path`.
        settings: As for `load_settings`, or what it returned.
        starts: Initial errors [s, y, theta], shape (3,) or (B, 3) [m, m, rad].
        start_arc_length: Where the virtual target starts [m].
        duration: Simulated time [s].
        rate: Control steps per second [Hz].
        learning: "cold", "warm" (learn until the weights settle, then start) or "frozen".
        robot: The simulated robot by name, or its imperfections, as in {"velocity_lag": 0.1}.
        record: Keep the trajectories.

    Raises:
        AdpError: An argument is wrong; the message names it.

    """
    chosen = _settings(settings)
    plant, faults = _robot(robot)
    return run_simulation(
        chosen,
        globals()["path"](path, settings=chosen),
        starts,
        start_arc_length=start_arc_length,
        duration=duration,
        rate=rate,
        learning=learning,
        plant=plant,
        faults=faults,
        record=record,
    )


def compare(
    path: PathLike = "lissajous",
    settings: SettingsLike = "default",
    *,
    controllers: Sequence[str] = ("adp", "lqr"),
    starts: ArrayLike | None = None,
    start_arc_length: float = 0.0,
    duration: float = 30.0,
    robot: Mapping[str, object] | str | None = None,
) -> Comparison:
    """Run controllers from the same starts, and beside the offline optimum (needs CasADi).

    Example: `adp.compare("circle:0.5", controllers=["adp", "lqr"], starts=[[0, 0.5, 0]])`.

    Args:
        path: As for `path`.
        settings: As for `load_settings`, or what it returned.
        controllers: Names, as `adp compare --list` prints them.
        starts: Initial errors [s, y, theta], shape (B, 3); forty if not given.
        start_arc_length: Where the virtual target starts [m].
        duration: Time [s] over which the cost is compared.
        robot: The simulated robot by name, or its imperfections, as in {"velocity_lag": 0.1}.

    Raises:
        AdpError: An argument is wrong, or CasADi is missing.

    """
    from adp_path_follower.study.comparison.compare import compare as run

    chosen = _settings(settings)
    plant, faults = _robot(robot)
    return run(
        chosen,
        str(path) if isinstance(path, str | FilePath) else "path",
        globals()["path"](path, settings=chosen),
        read_starts() if starts is None else checked_starts(starts),
        list(controllers),
        start_arc_length=start_arc_length,
        duration=duration,
        plant=plant,
        faults=faults,
    )


def optimum(
    path: PathLike = "lissajous",
    settings: SettingsLike = "paper",
    *,
    start: ArrayLike = PAPER_START,
    start_arc_length: float = 0.0,
    horizon: float = 30.0,
    robot: Mapping[str, object] | str | None = None,
) -> Optimum:
    """Return the optimal motion from one start, by offline optimal control (needs CasADi).

    Example: `adp.optimum("line", start=[0, 0.5, 0]).cost`.

    Args:
        path: As for `path`.
        settings: Speed, gains, cost and limits; the paper's, without limits, if not given.
        start: Initial error [s, y, theta], shape (3,).
        start_arc_length: Where the virtual target starts [m].
        horizon: Time [s] after which nothing is left to win.
        robot: As for `simulate`, known with delay, lags, ramps, gains and bias; ideal by default.

    Raises:
        AdpError: An argument is wrong, there is no optimum, or CasADi is missing.

    """
    from adp_path_follower.study.optimum.collocation import OptimumSolver

    chosen = _settings(settings)
    followed = globals()["path"](path, settings=chosen)
    plant, _ = _robot(robot)
    solver = OptimumSolver(chosen, followed, start_arc_length, horizon, plant)
    return solver.solve(np.asarray(start))


def analyze(bag: str | FilePath, *, topics: Mapping[str, str] | None = None) -> BagAnalysis:
    """Return the metrics and events of a recorded run.

    Example: `adp.analyze("my_bag").metrics["cross_track_rms"]`.

    Args:
        bag: A rosbag2 directory, or one of its files.
        topics: "odom", "cmd_vel" or "path" -> the topic to take for it; found if not given.

    Raises:
        FileError: The bag cannot be read, or holds no odometry or path.

    """
    from adp_path_follower.analysis.bag_analysis import analyse_bag

    return analyse_bag(expanded(os.fspath(bag)), topics or {}, 1, None)


def _settings(given: SettingsLike) -> Settings:
    return given if isinstance(given, Settings) else load_settings(given)


def _robot(given: Mapping[str, object] | str | None) -> tuple[PlantSettings, FaultScript]:
    return without_nodes(
        simulator_settings({"robot": given} if isinstance(given, str) else given or {})
    )
