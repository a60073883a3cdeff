"""Sweeps and tunings: which settings are tried under which conditions, as files say it."""

import functools
import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any, TypeVar

import numpy as np
from optuna.distributions import BaseDistribution
from scipy.stats import qmc

from adp_path_follower import __version__
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.files import read_yaml
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import parse_assignment
from adp_path_follower.core.settings.schema import (
    Value,
    build,
    flatten,
    setting,
    setting_fields,
)
from adp_path_follower.resources import did_you_mean
from adp_path_follower.study.sweeps.conditions import (
    CONDITION_ENTRIES,
    Conditions,
    RunSettings,
    errors_in,
    read_conditions,
    section,
)
from adp_path_follower.study.sweeps.ranges import (
    OWN,
    Listed,
    Range,
    Variation,
    read_variations,
    settings_values,
)

Tree = TypeVar("Tree")

_OTHER_ENTRIES = (*CONDITION_ENTRIES, "settings")
_MOST_RUNS = 100_000_000
_MOST_OBJECTIVES = 3
# Without `settings`, the learner's rates and the widths of its samples are tuned.
_RATES = {
    ("path_state", "gradient"): ("critic_gain_measured", "critic_gain_sampled", "actor_gain"),
    ("path_state", "least_squares"): ("actor_gain",),
    ("arc_length", "gradient"): ("critic_gain_sampled", "actor_gain", "preview_distance"),
    ("arc_length", "least_squares"): ("actor_gain", "preview_distance"),
}
_SAMPLES = "sample_half_widths"


@dataclass(frozen=True)
class Request:
    """Settings to try under given conditions."""

    conditions: Conditions  # starts, paths, robots, noise; the settings before
    variations: tuple[Variation, ...]  # varied settings, in the order of the table's columns
    objectives: tuple[str, ...]  # names of the numbers that are to be small; the first one ranks

    def settings_with(self, values: Mapping[str, Value]) -> Settings:
        """Return the settings with these values; SettingsError if they do not fit each other."""
        base = flatten(self.conditions.settings)
        return build(Settings, {**base, **settings_values(values, base)})

    @property
    def distributions(self) -> dict[str, BaseDistribution]:
        """Return what varies as Optuna has it: name of a variation -> distribution."""
        return {item.name: item.distribution for item in self.variations}

    def parameters(self, values: Mapping[str, Value]) -> dict[str, Any]:
        """Return all settings' values as Optuna has them; None for one out of its variation."""
        return {item.name: item.parameter(values[item.field.name]) for item in self.variations}

    def values(self, parameters: Mapping[str, Any]) -> dict[str, Value]:
        """Return the values of Optuna's parameters, by the names of the variations."""
        return {item.name: item.value(parameters[item.name]) for item in self.variations}

    def description(self) -> dict[str, str]:
        """Return everything that the results depend on: name -> text."""
        found = {**vars(self.conditions.run), **vars(self.conditions), **vars(self)}
        for name in ("conditions", "run", "objectives"):  # those give the others; these only judge
            del found[name]
        found["varied"] = found.pop("variations")
        return {name: _text(value) for name, value in found.items()}

    @property
    def digest(self) -> str:
        """Return what tells this request from any other, also of another version."""
        text = json.dumps([__version__, self.description()], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Sweep(Request):
    """All runs of a sweep, none of them done yet.

    Listed values are all combined, and each combination is tried at each point of the ranges. Run
    number n goes through noise and starts first (starts fastest), then robots, paths, and the
    combinations of settings last. The first two objectives make the Pareto front.
    """

    samples: int = 0  # number of points in the ranges, if there are ranges
    samples_seed: int = 0  # seed of the points

    @property
    def points(self) -> FloatArray:
        """Return points that fill the ranges evenly, as shares in [0, 1), shape (S, R)."""
        ranges = sum(isinstance(item, Range) for item in self.variations)
        return _sobol(ranges, self.samples, self.samples_seed)

    @property
    def combinations(self) -> int:
        """Return how many combinations of settings there are."""
        listed = (len(item.values) for item in self.variations if isinstance(item, Listed))
        return math.prod(listed) * max(1, self.samples)

    @property
    def runs(self) -> int:
        """Return the number of all runs."""
        return self.combinations * self.conditions.runs

    @property
    def parts(self) -> int:
        """Return the number of parts: the work of a worker at a time, and a file each."""
        return -(-self.runs // self.conditions.part_size)

    def runs_of(self, part: int) -> range:
        """Return the numbers of the runs of a part."""
        size = self.conditions.part_size
        return range(part * size, min((part + 1) * size, self.runs))

    def varied(self, combination: int) -> dict[str, Value]:
        """Return the values of a combination, by the names of the variations."""
        listed = [item for item in self.variations if isinstance(item, Listed)]
        ranges = [item for item in self.variations if isinstance(item, Range)]
        shape = [*(len(item.values) for item in listed), len(self.points)]
        *places, point = np.unravel_index(combination, shape)
        values = {item.name: item.values[place] for item, place in zip(listed, places, strict=True)}
        shares = zip(ranges, self.points[point].tolist(), strict=True)
        return {**values, **{item.name: item.at(share) for item, share in shares}}

    def settings(self, combination: int) -> Settings:
        """Return the settings of a combination; SettingsError if they do not fit each other."""
        varied = self.varied(combination)
        try:
            return self.settings_with(varied)
        except SettingsError as error:
            shown = ", ".join(f"{name}: {value}" for name, value in varied.items())
            raise SettingsError(f"the combination {shown} is not allowed: {error}") from None


@dataclass(frozen=True)
class SearchSettings:
    """Extent of a search."""

    trials: int = setting(200, "Settings to try", low=1, high=1_000_000)
    seed: int = setting(0, "Seed of the sampler", low=0, high=2**31 - 1)
    at_once: int = setting(8, "Trials under way at once, on any workers", low=1, high=10_000)


@dataclass(frozen=True)
class Tuning(Request):
    """A search for settings; with several objectives, for a Pareto front."""

    search: SearchSettings  # extent of the search

    def description(self) -> dict[str, str]:
        """Return everything that the results depend on, which the number of trials is not."""
        found = {**super().description(), "objectives": repr(self.objectives)}
        return {**found, "search": repr((self.search.seed, self.search.at_once))}


@functools.lru_cache(maxsize=1)
def _sobol(dimensions: int, samples: int, seed: int) -> FloatArray:
    """Return points that fill the unit cube evenly, shape (samples, dimensions)."""
    if not dimensions:
        return np.zeros((1, 0))
    sampler = qmc.Sobol(dimensions, scramble=True, seed=seed)
    # The first of 2^m points are drawn, which balances better than any other number.
    return np.asarray(sampler.random_base2(math.ceil(math.log2(samples)))[:samples])


def _text(value: object) -> str:
    """Return a text that tells a value from others."""
    if isinstance(value, np.ndarray):
        return f"{value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    return repr(value)


@dataclass(frozen=True)
class _Sampling:
    """Sampling of ranges."""

    samples: int = setting(0, "Points in the ranges", low=0, high=2**20)
    samples_seed: int = setting(0, "Seed of the points", low=0, high=2**31 - 1)


@dataclass(frozen=True)
class _SweepEntries:
    run: RunSettings
    sampling: _Sampling


@dataclass(frozen=True)
class _TuneEntries:
    run: RunSettings
    search: SearchSettings


def _read_entries(file: FilePath) -> dict[str, object]:
    """Return the NAME: VALUE entries of a YAML file; FileError or SettingsError if it has none."""
    content = read_yaml(file)
    if not isinstance(content, Mapping):
        raise SettingsError(f"file {file} must hold NAME: VALUE entries (adp docs sweeps)")
    return {str(name): value for name, value in content.items()}


def _build_entries(tree: type[Tree], entries: Mapping[str, object]) -> Tree:
    """Return the settings tree of a file's entries; SettingsError if one is wrong."""
    fields = {field.name: field for field in setting_fields(tree)}
    values: dict[str, object] = {}
    for name, value in entries.items():
        if name in fields:
            single = fields[name].item_kind is str and isinstance(value, str)
            values[name] = [value] if single else value
        elif name not in _OTHER_ENTRIES:
            raise SettingsError(
                f"unknown entry '{name}'{did_you_mean(name, [*_OTHER_ENTRIES, *fields])}"
            )
    return build(tree, values)


def read_sweep(file: FilePath) -> Sweep:
    """Return a file's sweep, every combination checked; AdpError names file, entry and remedy."""
    entries = _read_entries(file)
    with errors_in(f"file {file}"):
        asked = _build_entries(_SweepEntries, entries)
        conditions = read_conditions(entries, file.parent, asked.run)
        varied = read_variations(section(entries, "settings"), flatten(conditions.settings))
        listed = tuple(item for item in varied if isinstance(item, Listed))
        ranges = tuple(item for item in varied if isinstance(item, Range))
        samples, seed = asked.sampling.samples, asked.sampling.samples_seed
        if ranges and not samples:
            raise SettingsError(
                f"'settings' has ranges ({ranges[0].name}), so give the number of points in them: "
                "samples: 64"
            )
        if samples and not ranges:
            raise SettingsError("'samples' is given, but 'settings' has no range to sample")
        objectives = asked.run.objectives or ("cost", "effort")
        sweep = Sweep(conditions, (*listed, *ranges), objectives, samples, seed)
        if sweep.runs > _MOST_RUNS:
            raise SettingsError(
                f"these are {sweep.runs:,} runs, but at most {_MOST_RUNS:,} are possible: list "
                "fewer values, or sample ranges"
            )
        for combination in range(sweep.combinations):
            sweep.settings(combination)
    return sweep


def read_tuning(file: FilePath) -> Tuning:
    """Return the tuning of a file; the AdpError of a wrong entry names file, entry and remedy."""
    entries = _read_entries(file)
    with errors_in(f"file {file}"):
        return _tuning(entries, file.parent)


def tuning_of_options(
    params: FilePath | None,
    assignments: Iterable[str],
    vary: Iterable[str],
    objectives: Iterable[str],
) -> Tuning:
    """Return the tuning that options ask for, on the forty starts of the reference.

    `vary` has NAME for the setting's own range, or NAME=RANGE as in a file. The objective is `cost`
    if there is none. Raises AdpError if an option is wrong.
    """
    entries: dict[str, object] = {"starts": "forty"}
    if params is not None:
        entries["params"] = str(params)
    entries["set"] = dict(parse_assignment(text) for text in assignments)
    chosen = [parse_assignment(text) if "=" in text else (text, OWN) for text in vary]
    if chosen:
        entries["settings"] = dict(chosen)
    if names := list(objectives):
        entries["objectives"] = names
    with errors_in("tuning"):
        return _tuning(entries, FilePath())


def _tuning(entries: Mapping[str, object], folder: FilePath) -> Tuning:
    asked = _build_entries(_TuneEntries, entries)
    conditions = read_conditions(entries, folder, asked.run)
    if "settings" in entries:
        varied = section(entries, "settings")
    else:
        learning = conditions.settings.learning
        names = (*_RATES[learning.scheduling, learning.critic], _SAMPLES)
        varied = dict.fromkeys(names, OWN)
    variations = read_variations(varied, flatten(conditions.settings), own=True)
    if not variations:
        raise SettingsError("'settings' is empty: name a setting to tune, as in actor_gain: own")
    objectives = asked.run.objectives or ("cost",)
    if len(objectives) > _MOST_OBJECTIVES:
        raise SettingsError(
            f"'objectives' are {len(objectives)}, but at most {_MOST_OBJECTIVES} can be weighed "
            "against each other"
        )
    return Tuning(conditions, variations, objectives, asked.search)
