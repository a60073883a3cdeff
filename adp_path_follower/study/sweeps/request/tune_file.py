"""TUNE.yaml: which settings are tuned, on what, and for what."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower import __version__
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import parse_assignment
from adp_path_follower.core.settings.schema import Value, build, flatten, setting_fields
from adp_path_follower.study.sweeps.request.conditions import (
    CONDITION_ENTRIES,
    Conditions,
    read_conditions,
)
from adp_path_follower.study.sweeps.request.objectives import OBJECTIVES
from adp_path_follower.study.sweeps.request.ranges import (
    OWN,
    Listed,
    Variation,
    read_variations,
    settings_values,
)
from adp_path_follower.study.sweeps.request.sections import Section, read_sections
from adp_path_follower.study.sweeps.request.sweep_file import Sweep

_ENTRIES = (*CONDITION_ENTRIES, "settings", "trials", "seed", "at_once", "objectives")
# What is tuned where nothing is said: the rates and the samples of the learner.
_RATES = {
    ("path_state", "gradient"): ("critic_gain_measured", "critic_gain_sampled", "actor_gain"),
    ("path_state", "least_squares"): ("actor_gain",),
    ("arc_length", "gradient"): ("critic_gain_sampled", "actor_gain", "preview_distance"),
    ("arc_length", "least_squares"): ("actor_gain", "preview_distance"),
}
_SAMPLES = "sample_half_widths"
_MOST_OBJECTIVES = 3


@dataclass(frozen=True)
class Tuning:
    """What is tuned.

    Attributes:
        conditions: Starts, paths, robots, noise; the settings before.
        variations: What is varied, over which ranges.
        objectives: Names of what is to be small; with several, a Pareto front is sought.
        trials: Number of settings to try.
        seed: Of the sampler.
        at_once: Trials under way at the same time, whatever the number of workers.

    """

    conditions: Conditions
    variations: tuple[Variation, ...]
    objectives: tuple[str, ...]
    trials: int
    seed: int
    at_once: int

    def settings(self, values: Mapping[str, Value]) -> Settings:
        """Return the settings with values of what is varied, by name.

        Raises:
            SettingsError: They do not fit each other.

        """
        base = flatten(self.conditions.settings)
        return build(Settings, {**base, **settings_values(values, base)})

    def runs_with(self, settings: Settings) -> Sweep:
        """Return the runs of one trial: a sweep of one combination."""
        base, values = flatten(self.conditions.settings), flatten(settings)
        changed = tuple(
            Listed(field, (values[field.name],))
            for field in setting_fields(Settings)
            if values[field.name] != base[field.name]
        )
        return Sweep(self.conditions, changed, (), np.zeros((1, 0)), self.objectives, 0)

    def description(self) -> dict[str, object]:
        """Return everything that the results depend on but the number of trials, as JSON has it."""
        varied: list[object] = []
        for item in self.variations:
            if isinstance(item, Listed):
                varied.append([item.name, [repr(value) for value in item.values]])
            else:
                varied.append([item.name, item.low, item.high, item.log])
        return {
            **self.conditions.description(),
            "varied": varied,
            "objectives": list(self.objectives),
            "seed": self.seed,
            "at_once": self.at_once,
        }

    @property
    def digest(self) -> str:
        """Return what tells this tuning from any other, and from that of another version."""
        text = json.dumps([__version__, self.description()], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def read_tuning(file: FilePath) -> Tuning:
    """Return the tuning that a file asks for.

    Raises:
        AdpError: Something cannot be; the message names the file, the entry and the remedy.

    """
    return _tuning(read_sections(file))


def tuning_of_options(
    params: FilePath | None,
    assignments: Iterable[str],
    vary: Iterable[str],
    objectives: Iterable[str],
) -> Tuning:
    """Return the tuning that options ask for, on the forty starts of the reference.

    Args:
        params: Parameter file; the defaults without.
        assignments: NAME=VALUE that change it.
        vary: NAME, for the setting's own range, or NAME=RANGE as a file has it.
        objectives: Names; the cost without.

    Raises:
        AdpError: Something cannot be.

    """
    content: dict[object, object] = {"starts": "forty"}
    if params is not None:
        content["params"] = str(params)
    content["set"] = dict(parse_assignment(text) for text in assignments)
    chosen = [parse_assignment(text) if "=" in text else (text, OWN) for text in vary]
    if chosen:
        content["settings"] = dict(chosen)
    if names := list(objectives):
        content["objectives"] = names
    return _tuning(Section("tuning", FilePath(), content))


def with_trials(tuning: Tuning, trials: int | None) -> Tuning:
    """Return the tuning with another number of trials, if there is one."""
    return tuning if trials is None else dataclasses.replace(tuning, trials=trials)


def _tuning(content: Section) -> Tuning:
    content.only(_ENTRIES)
    conditions = read_conditions(content)
    section = content.section("settings")
    if "settings" not in content:
        learning = conditions.settings.learning
        names = (*_RATES[learning.scheduling, learning.critic], _SAMPLES)
        section = Section("settings", FilePath(), dict.fromkeys(names, OWN))
    variations = read_variations(section, flatten(conditions.settings), own=True)
    if not variations:
        raise content.problem("'settings' is empty: name a setting to tune, as in actor_gain: own")
    objectives = content.words("objectives", ["cost"])
    for name in objectives:
        if name not in OBJECTIVES:
            raise content.problem(
                f"unknown objective '{name}': choose from {', '.join(OBJECTIVES)}"
            )
    if len(objectives) > _MOST_OBJECTIVES:
        raise content.problem(
            f"'objectives' are {len(objectives)}, but at most {_MOST_OBJECTIVES} can be weighed "
            "against each other"
        )
    return Tuning(
        conditions=conditions,
        variations=variations,
        objectives=objectives,
        trials=content.whole("trials", 200, low=1, high=1_000_000),
        seed=content.whole("seed", 0, low=0, high=2**31 - 1),
        at_once=content.whole("at_once", 8, low=1, high=10_000),
    )
