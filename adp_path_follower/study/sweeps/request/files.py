"""Reads SWEEP.yaml and TUNE.yaml."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.settings.parameter_file import parse_assignment
from adp_path_follower.core.settings.schema import flatten, setting
from adp_path_follower.study.sweeps.request.conditions import (
    CONDITION_ENTRIES,
    RunSettings,
    read_conditions,
)
from adp_path_follower.study.sweeps.request.entries import (
    build_entries,
    errors_in,
    read_entries,
    section,
)
from adp_path_follower.study.sweeps.request.ranges import OWN, Listed, Range, read_variations
from adp_path_follower.study.sweeps.request.request import SearchSettings, Sweep, Tuning

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


def read_sweep(file: FilePath) -> Sweep:
    """Return a file's sweep, every combination checked; AdpError names file, entry and remedy."""
    entries = read_entries(file)
    with errors_in(f"file {file}"):
        asked = build_entries(_SweepEntries, entries, _OTHER_ENTRIES)
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
    entries = read_entries(file)
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
    asked = build_entries(_TuneEntries, entries, _OTHER_ENTRIES)
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
