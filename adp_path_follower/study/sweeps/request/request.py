"""Sweeps and tunings: which settings are tried under which conditions."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from adp_path_follower import __version__
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import Value, build, flatten, setting, setting_fields
from adp_path_follower.study.sweeps.request.conditions import Conditions
from adp_path_follower.study.sweeps.request.ranges import Listed, Range, Variation, settings_values


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

    points: FloatArray  # Sobol points in the ranges, shape (S, R); (1, 0) without ranges
    samples_seed: int = 0  # seed of the points

    @property
    def combinations(self) -> int:
        """Return how many combinations of settings there are."""
        listed = (len(item.values) for item in self.variations if isinstance(item, Listed))
        return math.prod(listed) * len(self.points)

    @property
    def runs_each(self) -> int:
        """Return the number of runs with the same settings, path and robot."""
        return len(self.conditions.noise_seeds) * len(self.conditions.starts)

    @property
    def groups_each(self) -> int:
        """Return how many pairs of path and robot each combination has."""
        return len(self.conditions.paths) * len(self.conditions.robots)

    @property
    def runs(self) -> int:
        """Return the number of all runs."""
        return self.combinations * self.groups_each * self.runs_each

    def varied(self, combination: int) -> dict[str, Value]:
        """Return the values of a combination, by the names of the variations."""
        rest, point = divmod(combination, len(self.points))
        shares = iter(reversed(self.points[point].tolist()))
        values: dict[str, Value] = {}
        for item in reversed(self.variations):
            if isinstance(item, Range):
                values[item.name] = item.at(next(shares))
            else:
                rest, place = divmod(rest, len(item.values))
                values[item.name] = item.values[place]
        return dict(reversed(values.items()))

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

    def runs_with(self, settings: Settings) -> Sweep:
        """Return the runs of one trial: a sweep of one combination."""
        base, values = flatten(self.conditions.settings), flatten(settings)
        changed = tuple(
            Listed(field, (values[field.name],))
            for field in setting_fields(Settings)
            if values[field.name] != base[field.name]
        )
        return Sweep(self.conditions, changed, self.objectives, np.zeros((1, 0)))

    def description(self) -> dict[str, str]:
        """Return everything that the results depend on, which the number of trials is not."""
        found = {**super().description(), "objectives": repr(self.objectives)}
        return {**found, "search": repr((self.search.seed, self.search.at_once))}


def _text(value: object) -> str:
    """Return a text that tells a value from others."""
    if isinstance(value, np.ndarray):
        return f"{value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    return repr(value)
