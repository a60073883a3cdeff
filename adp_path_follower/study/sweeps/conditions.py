"""The conditions of the runs: starts, paths, robots, noise and duration."""

import contextlib
import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower.core.errors import AdpError, SettingsError
from adp_path_follower.core.files import expanded, read_csv_columns
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import is_path_file, named_path, path_through, read_poses
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import build, setting, update
from adp_path_follower.resources import FORTY_STARTS, parameter_file
from adp_path_follower.study.simulation.simulate import (
    HIGHEST_RATE,
    LEARNING_MODES,
    PAPER_START,
    read_starts,
)
from adp_path_follower.study.sweeps.objectives import OBJECTIVES
from sim_unicycle.fault_script import FaultScript, without_nodes
from sim_unicycle.settings import PlantSettings, simulator_settings

CONDITION_ENTRIES = ("params", "set", "starts", "robots", "noise_seeds")
FORTY = "forty"
_STARTS_FORM = (
    "'starts' must be 'forty', a list of [s, y, theta], {file: starts.csv} or "
    "{random: 100, box: [1.0, 1.0, 1.0], seed: 0}"
)
_MOST_AT_ONCE = 128  # runs that one call simulates, to hide Python's overhead
_MOST_STARTS = 100_000
_MOST_SEED = 2**31 - 1
_MOST_SEEDS = 100_000
_FARTHEST = 1e9  # [m]
_NOISY = (
    *("position_noise", "heading_noise", "encoder_noise", "position_drift", "heading_drift"),
    *("odometry_drop", "odometry_jitter"),
)
_COSTS = FORTY_STARTS.with_name("forty_starts_optimum.csv")
_PATHS = ("lissajous", "line", "circle:0.5", "circle:1.0")
_LONG_ENOUGH = 15.0  # [s], after which J grows by less than 1e-8
WHERE_KNOWN = (
    "J* is known for 'starts: forty' on lissajous, line, circle:0.5 and circle:1.0 from their "
    "beginning, for 15 s and more, with the default cost, speed and target_gain, and without "
    "limits"
)


@dataclass(frozen=True)
class RunSettings:
    """Plain entries of sweep and tuning files."""

    paths: tuple[str, ...] = setting(("lissajous",), "Names or files of paths")
    objectives: tuple[str, ...] = setting(
        (), "Numbers that are to be small", choices=tuple(OBJECTIVES)
    )
    duration: float = setting(30.0, "Simulated time", unit="s", low=0.1, high=100_000.0)
    rate: float = setting(100.0, "Control steps per second", unit="Hz", low=1.0, high=HIGHEST_RATE)
    learning: str = setting("warm", "Learning, as in `adp simulate`", choices=LEARNING_MODES)
    start_arc_length: float = setting(
        0.0, "Start of the virtual target", unit="m", low=-_FARTHEST, high=_FARTHEST
    )

    def __post_init__(self) -> None:
        """Reject runs without a path, and names that are listed twice."""
        if not self.paths:
            raise SettingsError("'paths' is [], but must be a list of names")
        for entry, names in (("paths", self.paths), ("objectives", self.objectives)):
            if len(set(names)) < len(names):
                raise SettingsError(f"'{entry}' has a name twice: {', '.join(names)}")


@dataclass(frozen=True)
class _RandomStarts:
    """Random starts in a box about the path."""

    random: int = setting(100, "Number of starts", low=1, high=_MOST_STARTS)
    box: tuple[float, float, float] = setting(
        (1.0, 1.0, math.pi / 3.0), "Half-widths [s, y, theta]", low=0.0, high=1e9
    )
    seed: int = setting(0, "Seed of the starts", low=0, high=_MOST_SEED)


@dataclass(frozen=True)
class _RandomStartsEntry:
    starts: _RandomStarts


@dataclass(frozen=True)
class PathSource:
    """A path by its name; a path file with its points, so that other machines need no file."""

    name: str  # built-in name or file, as in the request
    digest: str = ""  # digest of the points, empty for built-in paths
    # Shape (N, 2), None for built-in paths.
    points: FloatArray | None = field(default=None, compare=False, repr=False)
    closed: bool | None = None  # whether the file says that the path is closed

    def path(self, settings: PathSettings) -> Path:
        """Return the path, prepared as the controller does; PathError if the points make none."""
        if self.points is None:
            return named_path(self.name, settings)
        return path_through(self.points, self.closed, settings)


@dataclass(frozen=True)
class Robot:
    """A simulated robot: its imperfections, and how they change with time."""

    name: str
    plant: PlantSettings
    faults: FaultScript

    @property
    def noisy(self) -> bool:
        """Return whether the seed makes a difference."""
        entries: list[Mapping[str, object]] = [vars(self.plant)]
        entries += [entry.values for entry in self.faults.entries]
        silent = vars(PlantSettings())
        return any(
            values.get(name, silent[name]) != silent[name] for values in entries for name in _NOISY
        )


@dataclass(frozen=True)
class Conditions:
    """Everything about the runs except the settings that are varied."""

    # The settings before anything is varied. J and effort are counted with their cost, whatever the
    # controller's own cost.
    settings: Settings
    starts: FloatArray  # initial errors [s, y, theta], shape (B, 3)
    forty: bool  # whether these are the forty starts of the reference
    paths: tuple[PathSource, ...]  # paths that are followed
    robots: tuple[Robot, ...]  # robots that follow them
    noise_seeds: tuple[int, ...]  # numbers of the noise sequences
    run: RunSettings  # duration, rate and learning of the runs

    @property
    def runs_each(self) -> int:
        """Return the number of runs with the same settings, path and robot."""
        return len(self.noise_seeds) * len(self.starts)

    @property
    def runs(self) -> int:
        """Return the number of runs with the same settings."""
        return self.runs_each * len(self.paths) * len(self.robots)

    @property
    def part_size(self) -> int:
        """Return how many runs are made and stored together: few files, and whole groups."""
        return _MOST_AT_ONCE // self.runs_each * self.runs_each or _MOST_AT_ONCE

    def optimal_costs(self, settings: Settings, source: PathSource) -> FloatArray:
        """Return J* of each start, of the ideal robot, by the cost here (B,); NaN if unknown."""
        name = source.name
        if name.startswith("circle:"):  # as the table has it, however its curvature is written
            name = f"circle:{float(name.removeprefix('circle:'))}"
        known = (
            self.forty
            and name in _PATHS
            and self.run.start_arc_length == 0.0
            and self.run.duration >= _LONG_ENOUGH
            and _reference_problem(self.settings, settings)
        )
        if not known:
            return np.full(len(self.starts), math.nan)
        return read_csv_columns(_COSTS, _PATHS)[:, _PATHS.index(name)]


@contextlib.contextmanager
def errors_in(place: str) -> Iterator[None]:
    """Turn an AdpError of the block into a SettingsError that names its file or section first."""
    try:
        yield
    except AdpError as error:
        raise SettingsError(f"{place}: {error}") from None


def section(entries: Mapping[str, object], name: str) -> dict[str, object]:
    """Return an entry that holds entries itself, empty if missing; SettingsError if it is none."""
    found = entries.get(name, {})
    if not isinstance(found, Mapping):
        raise SettingsError(f"'{name}' is {found!r}, but must be NAME: VALUE entries")
    return {str(key): value for key, value in found.items()}


def read_conditions(
    entries: Mapping[str, object], folder: FilePath, run: RunSettings
) -> Conditions:
    """Return a request's conditions, with files in a folder; AdpError names a wrong entry."""
    starts = _starts(entries.get("starts", [list(PAPER_START)]), folder)
    robots = _robots(section(entries, "robots"))
    return Conditions(
        settings=_base_settings(entries, folder),
        starts=starts,
        forty=entries.get("starts") == FORTY,
        paths=tuple(_path(name, folder) for name in run.paths),
        robots=robots,
        noise_seeds=_noise_seeds(entries.get("noise_seeds", 1), robots, len(starts)),
        run=run,
    )


def _base_settings(entries: Mapping[str, object], folder: FilePath) -> Settings:
    """Return the settings of `params`, a file or a shipped name, with the changes of `set`."""
    params = entries.get("params")
    file = None if params is None else _file("params", params, folder)
    if file is not None and not file.suffix and not file.is_file():
        file = parameter_file(str(params))
    return update(load_settings(Settings, "path_follower", file), section(entries, "set"))


def _file(entry: str, value: object, folder: FilePath) -> FilePath:
    if not isinstance(value, str):
        raise SettingsError(f"'{entry}' is {value!r}, but must be a file name")
    return folder / expanded(value)


def _starts(given: object, folder: FilePath) -> FloatArray:
    if given == FORTY:
        return read_starts()
    if isinstance(given, Mapping):
        if "file" in given:
            if len(given) > 1:
                raise SettingsError(_STARTS_FORM)
            named = _file("file", given["file"], folder)
            return _checked_starts(read_starts(named))
        with errors_in("starts"):
            entries = {str(name): value for name, value in given.items()}
            asked = build(_RandomStartsEntry, entries).starts
        uniform = np.random.default_rng(asked.seed).uniform(-1.0, 1.0, (asked.random, 3))
        return np.asarray(uniform * asked.box)
    return _checked_starts(given)


def _checked_starts(given: object) -> FloatArray:
    try:
        starts = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        starts = np.zeros(0)
    if starts.ndim != 2 or starts.shape[1] != 3 or not len(starts):
        raise SettingsError(_STARTS_FORM)
    if not np.isfinite(starts).all() or len(starts) > _MOST_STARTS:
        raise SettingsError(f"'starts' must be finite numbers, at most {_MOST_STARTS} starts")
    return starts


def _path(name: str, folder: FilePath) -> PathSource:
    with errors_in(f"path '{name}'"):
        if not is_path_file(name):
            source = PathSource(name)
        else:
            poses, closed = read_poses(folder / expanded(name))
            digest = hashlib.sha256(poses[:, :2].tobytes()).hexdigest()
            source = PathSource(name, digest, poses[:, :2], closed)
        source.path(PathSettings())
        return source


def _robots(entries: Mapping[str, object]) -> tuple[Robot, ...]:
    found = []
    for name in entries:
        with errors_in(f"robot '{name}'"):
            values = section(entries, name) if entries[name] is not None else {}
            if "seed" in values:
                raise SettingsError("remove its seed, and set noise_seeds")
            found.append(Robot(name, *without_nodes(simulator_settings(values))))
    return tuple(found) or (Robot("ideal", PlantSettings(), FaultScript()),)


def _noise_seeds(given: object, robots: tuple[Robot, ...], starts: int) -> tuple[int, ...]:
    most = _MOST_SEED // starts - 1
    seeds = given if isinstance(given, list) else []
    if isinstance(given, int) and not isinstance(given, bool):
        seeds = list(range(min(given, _MOST_SEEDS + 1)))
    allowed = all(type(seed) is int and 0 <= seed <= most for seed in seeds)
    if not (allowed and 0 < len(seeds) == len(set(seeds)) <= _MOST_SEEDS):
        raise SettingsError(
            f"'noise_seeds' is {given!r}, but must be a number of sequences (at most "
            f"{_MOST_SEEDS}), or a list of different integers from 0 to {most}"
        )
    if len(seeds) > 1 and not any(robot.noisy for robot in robots):
        raise SettingsError(
            f"'noise_seeds' asks for {len(seeds)} sequences of noise, but no robot of 'robots' is "
            "noisy: give one position_noise, or leave noise_seeds out"
        )
    return tuple(sorted(seeds))


def _reference_problem(base: Settings, settings: Settings) -> bool:
    standard = build(Settings, {})
    target, motion = settings.target, settings.motion
    return (
        base.cost == standard.cost
        and target.desired_speed == standard.target.desired_speed
        and target.target_gain == standard.target.target_gain
        and settings.limits.unlimited
        and not motion.limited
        and math.isinf(motion.max_lateral_accel)
    )
