"""What settings are tried on: starts, paths, robots and noise, and for how long."""

from __future__ import annotations

import hashlib
import importlib.resources
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from adp_path_follower.core.errors import AdpError, SettingsError
from adp_path_follower.core.files import read_csv_columns
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import is_path_file, named_path, path_through, read_points
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import build, flatten
from adp_path_follower.study.simulation.robot import without_nodes
from adp_path_follower.study.simulation.simulate import HIGHEST_RATE, LEARNING_MODES, PAPER_START
from adp_path_follower.study.sweeps.request.sections import Section
from sim_unicycle.fault_script import FaultScript
from sim_unicycle.settings import PlantSettings, SimulatorSettings

CONDITION_ENTRIES = (
    *("params", "set", "starts", "paths", "robots", "noise_seeds"),
    *("duration", "rate", "learning", "start_arc_length"),
)
FORTY = "forty"
_STARTS_FORM = (
    "'forty', a list of [s, y, theta], {file: starts.csv} or "
    "{random: 100, box: [1.0, 1.0, 1.0], seed: 0}"
)
_MOST_STARTS = 100_000
_MOST_SEED = 2**31 - 1
_MOST_SEEDS = 100_000
_LONGEST = 100_000.0  # [s], more than a day
_NOISY = ("position_noise", "heading_noise", "position_drift", "heading_drift", "odometry_drop")


@dataclass(frozen=True)
class PathSource:
    """A path by its name; of a file with its points, so that other machines need no file.

    Attributes:
        name: As in the file: a built-in name, or a file.
        digest: Of the points, empty for built-in paths.
        points: Shape (N, 2), None for built-in paths.
        closed: What the file says about its end.

    """

    name: str
    digest: str = ""
    points: FloatArray | None = field(default=None, compare=False, repr=False)
    closed: bool | None = None

    def path(self, settings: PathSettings) -> Path:
        """Return the path, prepared as the controller does.

        Raises:
            PathError: The points make no path.

        """
        if self.points is None:
            return named_path(self.name, settings)
        return path_through(self.points, self.closed, settings)


@dataclass(frozen=True)
class Robot:
    """A simulated robot: its imperfections, and how they change with time."""

    name: str
    plant: PlantSettings
    faults: FaultScript
    values: tuple[tuple[str, object], ...]

    @property
    def noisy(self) -> bool:
        """Return whether the seed makes a difference."""
        entries: list[Mapping[str, object]] = [vars(self.plant)]
        entries += [entry.values for entry in self.faults.entries]
        return any(bool(values.get(name, 0.0)) for values in entries for name in _NOISY)


@dataclass(frozen=True)
class Conditions:
    """Everything about the runs but the settings that are varied.

    Attributes:
        settings: The settings before anything is varied. Their cost is what J and effort are
            counted with, whatever the controller's own.
        starts: Initial errors [s, y, theta], shape (B, 3).
        forty: Whether they are the forty of the reference.
        paths: What is followed.
        robots: What follows.
        noise_seeds: Numbers of the sequences of noise.
        duration: Simulated time of a run [s].
        rate: Control steps per second [Hz].
        learning: As `simulate` has it.
        start_arc_length: Where the virtual target starts [m].

    """

    settings: Settings
    starts: FloatArray
    forty: bool
    paths: tuple[PathSource, ...]
    robots: tuple[Robot, ...]
    noise_seeds: tuple[int, ...]
    duration: float
    rate: float
    learning: str
    start_arc_length: float

    def description(self) -> dict[str, object]:
        """Return everything that the results depend on, as JSON has it."""
        return {
            "settings": {name: repr(value) for name, value in flatten(self.settings).items()},
            "starts": self.starts.tolist(),
            "paths": [[path.name, path.digest, path.closed] for path in self.paths],
            "robots": [[robot.name, _robot_text(robot)] for robot in self.robots],
            "noise_seeds": list(self.noise_seeds),
            "duration": self.duration,
            "rate": self.rate,
            "learning": self.learning,
            "start_arc_length": self.start_arc_length,
        }


def read_conditions(file: Section) -> Conditions:
    """Return the conditions that a file asks for.

    Raises:
        AdpError: An entry cannot be; the message names it.

    """
    starts, forty = _starts(file)
    robots = _robots(file)
    learning = file.choice("learning", "warm", LEARNING_MODES)
    return Conditions(
        settings=base_settings(file),
        starts=starts,
        forty=forty,
        paths=tuple(_path(file, name) for name in file.words("paths", ["lissajous"])),
        robots=robots,
        noise_seeds=_noise_seeds(file, robots, len(starts)),
        duration=file.number("duration", 30.0, low=0.1, high=_LONGEST),
        rate=file.number("rate", 100.0, low=1.0, high=HIGHEST_RATE),
        learning=learning,
        start_arc_length=file.number("start_arc_length", 0.0, low=-math.inf),
    )


def base_settings(file: Section) -> Settings:
    """Return the settings of `params` with the changes of `set`."""
    changes = dict(file.section("set").items())
    params = file.file_entry("params")
    try:
        settings = load_settings(Settings, "path_follower", params)
        return build(Settings, {**flatten(settings), **changes})
    except SettingsError as error:
        raise file.problem(str(error)) from None


def forty_starts() -> FloatArray:
    """Return the forty starts of the reference, shape (40, 3)."""
    file = importlib.resources.files("adp_path_follower") / "data" / "forty_starts.csv"
    with importlib.resources.as_file(file) as path:
        return read_csv_columns(path, ("s", "y", "theta"))


def _starts(file: Section) -> tuple[FloatArray, bool]:
    given = file.get("starts", [list(PAPER_START)])
    if given == FORTY:
        return forty_starts(), True
    if isinstance(given, Mapping):
        section = file.section("starts")
        if "file" in section:
            section.only(("file",))
            named = section.file_entry("file")
            if named is None:
                raise section.problem("'file' is empty: name a CSV file with columns s,y,theta")
            return _checked_starts(file, read_csv_columns(named, ("s", "y", "theta"))), False
        section.only(("random", "box", "seed"))
        return _random_starts(section), False
    return _checked_starts(file, given), False


def _random_starts(section: Section) -> FloatArray:
    count = section.whole("random", 100, low=1, high=_MOST_STARTS)
    seed = section.whole("seed", 0, low=0, high=_MOST_SEED)
    box = section.get("box", [1.0, 1.0, math.pi / 3.0])
    try:
        half_widths = np.asarray(box, dtype=float)
    except (TypeError, ValueError):
        half_widths = np.zeros(0)
    if half_widths.shape != (3,) or not np.isfinite(half_widths).all() or (half_widths < 0.0).any():
        raise section.problem(
            f"'box' is {box!r}, but must be the half-widths [s, y, theta] about the path, three "
            "numbers that are not negative"
        )
    uniform = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3))
    return np.asarray(uniform * half_widths)


def _checked_starts(file: Section, given: object) -> FloatArray:
    try:
        starts = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        starts = np.zeros(0)
    if starts.ndim != 2 or starts.shape[1] != 3 or not len(starts):
        raise file.problem(f"'starts' must be {_STARTS_FORM}")
    if not np.isfinite(starts).all() or len(starts) > _MOST_STARTS:
        raise file.problem(f"'starts' must be finite numbers, at most {_MOST_STARTS} starts")
    return starts


def _path(file: Section, name: str) -> PathSource:
    if not is_path_file(name):
        source = PathSource(name)
    else:
        points, closed = read_points(file.beside(name))
        digest = hashlib.sha256(np.ascontiguousarray(points).tobytes()).hexdigest()
        source = PathSource(name, digest, points, closed)
    try:
        source.path(PathSettings())
    except AdpError as error:
        raise file.problem(f"path '{name}': {error}") from None
    return source


def _robots(file: Section) -> tuple[Robot, ...]:
    section = file.section("robots")
    found = []
    for name, given in section.items():
        values = {} if given is None else given
        if not isinstance(values, Mapping):
            raise section.problem(f"'{name}' is {given!r}, but must be NAME: VALUE of the robot")
        if "seed" in values:
            raise section.problem(f"'{name}' has a seed: leave it out, and set noise_seeds")
        try:
            settings = build(SimulatorSettings, {str(key): item for key, item in values.items()})
            plant, faults = without_nodes(settings)
        except AdpError as error:
            raise section.problem(f"robot '{name}': {error}") from None
        found.append(Robot(name, plant, faults, tuple((str(k), v) for k, v in values.items())))
    return tuple(found) or (Robot("ideal", PlantSettings(), FaultScript(), ()),)


def _noise_seeds(file: Section, robots: tuple[Robot, ...], starts: int) -> tuple[int, ...]:
    given = file.get("noise_seeds", 1)
    most = _MOST_SEED // starts - 1
    listed = given if isinstance(given, list) else [given]
    seeds = [seed for seed in listed if isinstance(seed, int) and not isinstance(seed, bool)]
    if len(seeds) < len(listed):
        seeds = []
    elif not isinstance(given, list):
        seeds = list(range(min(seeds[0], _MOST_SEEDS + 1)))
    allowed = all(0 <= seed <= most for seed in seeds) and len(set(seeds)) == len(seeds)
    if not 0 < len(seeds) <= _MOST_SEEDS or not allowed:
        raise file.problem(
            f"'noise_seeds' is {given!r}, but must be how many (at most {_MOST_SEEDS}), or a list "
            f"of different integers from 0 to {most}"
        )
    if len(seeds) > 1 and not any(robot.noisy for robot in robots):
        raise file.problem(
            f"'noise_seeds' asks for {len(seeds)} sequences of noise, but no robot of 'robots' is "
            "noisy: give one position_noise, or leave noise_seeds out"
        )
    return tuple(sorted(seeds))


def _robot_text(robot: Robot) -> str:
    script = [
        [entry.at, entry.duration, entry.every, entry.values] for entry in robot.faults.entries
    ]
    return repr((robot.plant, script))
