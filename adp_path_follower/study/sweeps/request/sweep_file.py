"""SWEEP.yaml: which settings, on what, and what makes them good."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from scipy.stats import qmc

from adp_path_follower import __version__
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import Value, build, flatten
from adp_path_follower.study.sweeps.request.conditions import (
    CONDITION_ENTRIES,
    Conditions,
    read_conditions,
)
from adp_path_follower.study.sweeps.request.objectives import OBJECTIVES
from adp_path_follower.study.sweeps.request.ranges import (
    Listed,
    Range,
    Variation,
    read_variations,
    settings_values,
)
from adp_path_follower.study.sweeps.request.sections import read_sections

_ENTRIES = (*CONDITION_ENTRIES, "settings", "samples", "samples_seed", "objectives")
_DEFAULT_OBJECTIVES = ("cost", "effort")
_MOST_SAMPLES = 2**20
_MOST_RUNS = 100_000_000


@dataclass(frozen=True)
class Sweep:
    """All runs of a sweep, without any of them being made yet.

    Run number n goes through noise and starts first (starts fastest), then robots, paths, and the
    combinations of settings last.

    Attributes:
        conditions: Starts, paths, robots, noise.
        listed: Settings whose values are all combined.
        ranges: What is sampled beside them.
        points: Sobol points in the ranges, shape (S, R); one point of nothing without ranges.
        objectives: Names: the first ranks, the first two make the Pareto front.

    """

    conditions: Conditions
    listed: tuple[Listed, ...]
    ranges: tuple[Range, ...]
    points: FloatArray
    objectives: tuple[str, ...]
    samples_seed: int

    @property
    def variations(self) -> tuple[Variation, ...]:
        """Return what varies, in the order of the table's columns."""
        return (*self.listed, *self.ranges)

    @property
    def combinations(self) -> int:
        """Return how many combinations of settings there are."""
        return math.prod(len(item.values) for item in self.listed) * len(self.points)

    @property
    def runs_each(self) -> int:
        """Return the number of runs with the same settings, on one path with one robot."""
        return len(self.conditions.noise_seeds) * len(self.conditions.starts)

    @property
    def groups_each(self) -> int:
        """Return how many paths with robots there are for each combination."""
        return len(self.conditions.paths) * len(self.conditions.robots)

    @property
    def runs(self) -> int:
        """Return the number of all runs."""
        return self.combinations * self.groups_each * self.runs_each

    def varied(self, combination: int) -> dict[str, Value]:
        """Return the values of what varies, by name, of a combination."""
        rest, point = divmod(combination, len(self.points))
        values: dict[str, Value] = {}
        for item in reversed(self.listed):
            rest, place = divmod(rest, len(item.values))
            values[item.name] = item.values[place]
        values = dict(reversed(values.items()))
        for sampled, share in zip(self.ranges, self.points[point], strict=True):
            values[sampled.name] = sampled.at(float(share))
        return values

    def settings(self, combination: int) -> Settings:
        """Return the settings of a combination.

        Raises:
            SettingsError: They do not fit each other.

        """
        base = flatten(self.conditions.settings)
        varied = self.varied(combination)
        try:
            return build(Settings, {**base, **settings_values(varied, base)})
        except SettingsError as error:
            shown = ", ".join(f"{name}: {value}" for name, value in varied.items())
            raise SettingsError(f"the combination {shown} cannot be: {error}") from None

    def description(self) -> dict[str, object]:
        """Return everything that the results depend on, as JSON has it."""
        return {
            **self.conditions.description(),
            "listed": [[item.name, [repr(value) for value in item.values]] for item in self.listed],
            "ranges": [[item.name, item.low, item.high, item.log] for item in self.ranges],
            "samples": len(self.points) if self.ranges else 0,
            "samples_seed": self.samples_seed,
        }

    @property
    def digest(self) -> str:
        """Return what tells this sweep from any other, and from that of another version."""
        text = json.dumps([__version__, self.description()], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def read_sweep(file: FilePath) -> Sweep:
    """Return the sweep that a file asks for; every combination of settings is checked.

    Raises:
        AdpError: Something cannot be; the message names the file, the entry and the remedy.

    """
    content = read_sections(file)
    content.only(_ENTRIES)
    conditions = read_conditions(content)
    variations = read_variations(content.section("settings"), flatten(conditions.settings))
    ranges = tuple(item for item in variations if isinstance(item, Range))
    samples = content.whole("samples", 0, low=0, high=_MOST_SAMPLES)
    if ranges and not samples:
        raise content.problem(
            f"'settings' has ranges ({ranges[0].name}), so say how many points in them: samples: 64"
        )
    if samples and not ranges:
        raise content.problem("'samples' is given, but 'settings' has no range to sample")
    seed = content.whole("samples_seed", 0, low=0, high=2**31 - 1)
    objectives = content.words("objectives", _DEFAULT_OBJECTIVES)
    for name in objectives:
        if name not in OBJECTIVES:
            raise content.problem(
                f"unknown objective '{name}': choose from {', '.join(OBJECTIVES)}"
            )
    sweep = Sweep(
        conditions=conditions,
        listed=tuple(item for item in variations if isinstance(item, Listed)),
        ranges=ranges,
        points=_sobol(len(ranges), samples, seed),
        objectives=objectives,
        samples_seed=seed,
    )
    if sweep.runs > _MOST_RUNS:
        raise content.problem(
            f"these are {sweep.runs:,} runs, but at most {_MOST_RUNS:,} are possible: list fewer "
            "values, or sample ranges"
        )
    for combination in range(sweep.combinations):
        try:
            sweep.settings(combination)
        except SettingsError as error:
            raise content.problem(str(error)) from None
    return sweep


def _sobol(dimensions: int, samples: int, seed: int) -> FloatArray:
    """Return points that fill the unit cube evenly, shape (samples, dimensions)."""
    if not dimensions:
        return np.zeros((1, 0))
    sampler = qmc.Sobol(dimensions, scramble=True, seed=seed)
    # The first of 2^m points are drawn, which balances better than any other number.
    points = sampler.random_base2(max(0, math.ceil(math.log2(samples))))
    return np.asarray(points[:samples])
