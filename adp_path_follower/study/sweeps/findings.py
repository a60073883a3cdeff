"""What a tuning found: the best settings, how much better they are, and which of them matter."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial

from adp_path_follower import __version__
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.files import output_to, write_output
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings, parameter_file_text
from adp_path_follower.core.settings.schema import Value, flatten
from adp_path_follower.study.sweeps.overview import shown
from adp_path_follower.study.sweeps.request.ranges import Listed, Variation
from adp_path_follower.study.sweeps.request.tune_file import Tuning
from adp_path_follower.study.sweeps.score import Score
from adp_path_follower.study.sweeps.study import baseline, refused, score_of, tried, values_of

_LEAST_TRIALS = 20  # of which the importance of settings can be told
_BEST_SHARE = 0.1  # of the trials: the good ones
_AT_END = 0.02  # of a range: its end


@dataclass(frozen=True)
class Importance:
    """How much a setting matters.

    Attributes:
        item: What was varied.
        share: Of the difference between good and other settings, from 0 to 1; NaN of too few
            trials.
        before: Its value in the settings before; None if it is one of a list.
        best: Its value in the best settings.
        good: Where the best tenth of the trials has it: lowest and highest, or the commonest value.
        at_end: Whether the best value is at an end of the range.

    """

    item: Variation
    share: float
    before: Value
    best: Value
    good: str
    at_end: bool


@dataclass(frozen=True)
class Findings:
    """What a tuning found.

    Attributes:
        tuning: What was tuned.
        before: The score of the settings before.
        best: The best trial: stable on every run, with the least objective, or of several the most
            even compromise; None if there is no stable one.
        front: The stable trials that no other is better than in everything.
        importances: What matters most first, for the first objective.
        trials: Number of trials.
        unstable: How many of them were unstable in some run.
        refused: Settings that the validation refused before any run: sentence -> how often.

    """

    tuning: Tuning
    before: Score
    best: FrozenTrial | None
    front: tuple[FrozenTrial, ...]
    importances: tuple[Importance, ...]
    trials: int
    unstable: int
    refused: dict[str, int]

    def settings(self, trial: FrozenTrial) -> Settings:
        """Return the settings of a trial."""
        return self.tuning.settings(values_of(self.tuning, trial.params))


def findings(study: optuna.Study, tuning: Tuning) -> Findings:
    """Return what a study found."""
    trials = tried(study)
    stable = [trial for trial in trials if not score_of(trial).unstable]
    front = _front(stable)
    reasons: dict[str, int] = {}
    for reason in refused(study):
        reasons[reason] = reasons.get(reason, 0) + 1
    best = _compromise(front)
    return Findings(
        tuning=tuning,
        before=baseline(study),
        best=best,
        front=tuple(front),
        importances=_importances(tuning, stable, best) if best is not None else (),
        trials=len(trials),
        unstable=len(trials) - len(stable),
        refused=reasons,
    )


def findings_text(found: Findings) -> str:
    """Return what was found, in words and a table."""
    objectives = " and ".join(found.tuning.objectives)
    lines = [
        f"{found.trials:,} settings tried for {objectives}, on {found.before.runs:,} runs each; "
        f"{found.unstable:,} unstable in some run; "
        f"{sum(found.refused.values()):,} refused before any run"
    ]
    lines += [f"  refused {count} times: {text}" for text, count in found.refused.items()][:3]
    if found.before.problem:
        lines.append(f"the settings before cannot run: {found.before.problem}")
    if found.best is None:
        lines.append(
            "no settings in the ranges are stable in all runs: change the ranges, or try more"
        )
        return "\n".join(lines)
    best = score_of(found.best)
    lines += ["", _table(found.before, best)]
    if not _better(found, best):
        lines.append("Nothing is better than the settings before.")
    if len(found.front) > 1:
        lines.append(
            f"{len(found.front)} settings are on the Pareto front; these are the most even "
            "compromise"
        )
    lines += ["", *_importance_lines(found)]
    return "\n".join(lines)


def write_findings(found: Findings, title: str, directory: FilePath) -> list[FilePath]:
    """Write the best settings as a parameter file, and those of the front; return the files.

    Those of a front that was larger before are removed.

    Raises:
        AdpError: A file cannot be written, or does not give the settings again.

    """
    if found.best is None:
        return []
    files = [_write(found, found.best, title, directory / "best.yaml")]
    folder = directory / "front"
    front = found.front if len(found.front) > 1 else ()
    if front:
        with output_to(folder):
            folder.mkdir(exist_ok=True)
    for number, trial in enumerate(front, start=1):
        _write(found, trial, title, folder / f"{number:03d}.yaml")
    for file in folder.glob("*.yaml"):
        if file.stem.isdigit() and int(file.stem) > len(front):
            with output_to(file):
                file.unlink()
    return files


def as_json(found: Findings) -> dict[str, Any]:
    """Return what was found as JSON has it."""
    return {
        "objectives": list(found.tuning.objectives),
        "trials": found.trials,
        "unstable": found.unstable,
        "refused": found.refused,
        "before": found.before.as_json(),
        "best": None if found.best is None else _trial_json(found, found.best),
        "front": [_trial_json(found, trial) for trial in found.front],
        "importance": {item.item.name: item.share for item in found.importances},
    }


def _trial_json(found: Findings, trial: FrozenTrial) -> dict[str, Any]:
    return {
        "trial": trial.number,
        "settings": values_of(found.tuning, trial.params),
        "score": score_of(trial).as_json(),
    }


def _write(found: Findings, trial: FrozenTrial, title: str, file: FilePath) -> FilePath:
    settings = found.settings(trial)
    score = score_of(trial)
    numbers = ", ".join(
        f"{name} {score.objectives[name]:.5g} (before: {found.before.objectives[name]:.5g})"
        for name in found.tuning.objectives
    )
    values = values_of(found.tuning, trial.params)
    changed = ", ".join(f"{name}: {shown(value)}" for name, value in values.items())
    write_output(
        file,
        f"# Found by adp tune {__version__} for {title}, trial {trial.number}: {numbers}.\n"
        f"# Tuned: {changed}.\n" + parameter_file_text(settings, "path_follower"),
    )
    if load_settings(Settings, "path_follower", file) != settings:
        raise AdpError(f"file {file} does not give the settings again that were written to it")
    return file


def _front(trials: list[FrozenTrial]) -> list[FrozenTrial]:
    """Return the trials that no other is better than in everything, by the first objective."""
    points = np.array([trial.values for trial in trials]).reshape(len(trials), -1)
    front: list[FrozenTrial] = []
    for trial, point in zip(trials, points, strict=True):
        no_worse = (points <= point).all(axis=1)
        better = (points < point).any(axis=1)
        if not (no_worse & better).any():
            front.append(trial)
    front.sort(key=lambda trial: tuple(trial.values))
    if points.shape[1] == 1:
        return front[:1]
    return front


def _compromise(front: list[FrozenTrial]) -> FrozenTrial | None:
    """Return the trial nearest to the best of each objective, each by its spread on the front."""
    if not front:
        return None
    points = np.array([trial.values for trial in front])
    spread = np.maximum(np.ptp(points, axis=0), 1e-12)
    distance = np.linalg.norm((points - points.min(axis=0)) / spread, axis=1)
    return front[int(np.argmin(distance))]


def _importances(
    tuning: Tuning, stable: list[FrozenTrial], best: FrozenTrial
) -> tuple[Importance, ...]:
    shares = _shares(tuning, stable)
    base = flatten(tuning.conditions.settings)
    values = values_of(tuning, best.params)
    ranked = sorted(stable, key=lambda trial: trial.values[0])
    good = [
        values_of(tuning, trial.params)
        for trial in ranked[: max(3, int(_BEST_SHARE * len(ranked)))]
    ]
    found = []
    for item in tuning.variations:
        before = base[item.field.name]
        if not isinstance(item, Listed):
            before = item.number_in(before)
        found.append(
            Importance(
                item,
                shares.get(item.name, float("nan")),
                before,
                values[item.name],
                _where(item, [some[item.name] for some in good]),
                _is_at_end(item, values[item.name]),
            )
        )
    return tuple(sorted(found, key=lambda each: -np.nan_to_num(each.share)))


def _shares(tuning: Tuning, stable: list[FrozenTrial]) -> dict[str, float]:
    """Return how much each setting explains of which trials are among the best (PED-ANOVA)."""
    if len(stable) < _LEAST_TRIALS or len(tuning.variations) == 1:
        return {tuning.variations[0].name: 1.0} if len(tuning.variations) == 1 else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # experimental features are said to be so
        study = optuna.create_study()
        study.add_trials(
            [
                optuna.trial.create_trial(
                    params=trial.params, distributions=trial.distributions, value=trial.values[0]
                )
                for trial in stable
            ]
        )
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        found = optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {name: float(share) for name, share in found.items()}


def _where(item: Variation, values: list[Value]) -> str:
    if isinstance(item, Listed):
        commonest = max(item.values, key=values.count)
        return f"{shown(commonest)} in {values.count(commonest)} of {len(values)}"
    numbers = np.array(values, dtype=float)
    return f"{numbers.min():.4g} to {numbers.max():.4g}"


def _is_at_end(item: Variation, value: Value) -> bool:
    if isinstance(item, Listed):
        return False
    ends = np.array([item.low, item.high, float(value)])  # type: ignore[arg-type]  # a number
    low, high, here = np.log(ends) if item.log else ends
    return bool(min(here - low, high - here) < _AT_END * (high - low))


def _better(found: Findings, best: Score) -> bool:
    names = found.tuning.objectives
    return bool(found.before.unstable) or any(
        best.objectives[name] < found.before.objectives[name] for name in names
    )


def _table(before: Score, best: Score) -> str:
    unit = "J/J*" if best.relative else "J"
    rows: list[tuple[str, str | float, str | float]] = [
        ("", "before", "found"),
        (f"{unit}, mean", before.objectives["cost"], best.objectives["cost"]),
        (f"{unit}, median", before.median, best.median),
        (f"{unit}, 95 %", before.high, best.high),
        (f"{unit}, greatest", before.largest, best.largest),
        ("effort, mean", before.objectives["effort"], best.objectives["effort"]),
        (
            "cross-track RMS [m]",
            before.objectives["cross_track"],
            best.objectives["cross_track"],
        ),
        (
            "cross-track, greatest [m]",
            before.objectives["worst_cross_track"],
            best.objectives["worst_cross_track"],
        ),
        ("unstable runs", str(before.unstable), str(best.unstable)),
    ]
    return "\n".join(f"{name:28}{_cell(first):>12}{_cell(last):>12}" for name, first, last in rows)


def _cell(value: str | float) -> str:
    if isinstance(value, str):
        return value
    return f"{value:.4f}" if value < 1e6 else "–"


def _importance_lines(found: Findings) -> list[str]:
    rows = [("setting", "matters", "before", "found", "the best tenth has")]
    for each in found.importances:
        share = "–" if np.isnan(each.share) else f"{100.0 * each.share:.0f} %"
        end = "  (at the end of its range: widen it?)" if each.at_end else ""
        rows.append((each.item.name, share, shown(each.before), shown(each.best), each.good + end))
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=False))
        + f"  {row[4]}"
        for row in rows
    ]
