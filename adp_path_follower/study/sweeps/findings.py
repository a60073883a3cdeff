"""Findings of a tuning: the best settings, their gain, and the settings that matter."""

import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial

from adp_path_follower import __version__
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.files import output_to
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import Value, flatten
from adp_path_follower.study.sweeps.overview import shown, write_settings
from adp_path_follower.study.sweeps.request.objectives import Score
from adp_path_follower.study.sweeps.request.ranges import Listed, Variation
from adp_path_follower.study.sweeps.request.request import Tuning
from adp_path_follower.study.sweeps.study import baseline, refused, score_of, tried, values_of

_LEAST_TRIALS = 20  # fewer do not tell how much a setting matters
_BEST_SHARE = 0.1  # of the trials: the good ones
_AT_END = 0.02  # of a range: its end


@dataclass(frozen=True)
class Findings:
    """Result of a tuning."""

    tuning: Tuning  # the tuning
    before: Score  # score of the settings before
    # Trials that are stable on every run, the best first by the first objective.
    stable: tuple[FrozenTrial, ...]
    # Stable trials that no other trial dominates; one trial for a single objective.
    front: tuple[FrozenTrial, ...]
    # Trial of the front with the most even compromise; None if no trial is stable.
    best: FrozenTrial | None
    # Variation -> its share in what tells the best trials from the others (PED-ANOVA), from 0 to 1;
    # empty for too few trials.
    importance: dict[str, float]
    trials: int  # number of trials
    refused: dict[str, int]  # sentence -> number of settings that the validation rejected with it

    @property
    def unstable(self) -> int:
        """Return the number of trials with an unstable run."""
        return self.trials - len(self.stable)

    def values(self, trial: FrozenTrial) -> dict[str, Value]:
        """Return the values of a trial, by the names of the variations."""
        return values_of(self.tuning, trial.params)

    def settings(self, trial: FrozenTrial) -> Settings:
        """Return the settings of a trial."""
        return self.tuning.settings_with(self.values(trial))


def findings(study: optuna.Study, tuning: Tuning) -> Findings:
    """Return the findings of a study."""
    trials = tried(study)
    stable = [trial for trial in trials if not score_of(trial).unstable]
    front = sorted(study.best_trials, key=lambda trial: tuple(trial.values))
    if len(tuning.objectives) == 1:
        front = front[:1]
    return Findings(
        tuning=tuning,
        before=baseline(study),
        stable=tuple(sorted(stable, key=lambda trial: trial.values[0])),
        front=tuple(front),
        best=_compromise(front),
        importance=_importance(tuning, stable),
        trials=len(trials),
        refused=dict(Counter(refused(study))),
    )


def findings_text(found: Findings) -> str:
    """Return the findings in words and a table."""
    objectives = " and ".join(found.tuning.objectives)
    lines = [
        f"{found.trials:,} settings tried for {objectives}, on {found.before.runs:,} runs each; "
        f"{found.unstable:,} unstable in some run; "
        f"{sum(found.refused.values()):,} rejected before any run"
    ]
    lines += [f"  rejected {count} times: {text}" for text, count in found.refused.items()][:3]
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
    lines += ["", *_importance_lines(found, found.best)]
    return "\n".join(lines)


def write_findings(found: Findings, title: str, directory: FilePath) -> list[FilePath]:
    """Write best settings and front anew as parameter files; return the first, or AdpError."""
    if found.best is None:
        return []
    files = [_write(found, found.best, title, directory / "best.yaml")]
    folder = directory / "front"
    front = found.front if len(found.front) > 1 else ()
    with output_to(folder):
        if front:
            folder.mkdir(exist_ok=True)
        for file in folder.glob("*.yaml"):
            if file.stem.isdigit() and int(file.stem) > len(front):
                file.unlink()
    for number, trial in enumerate(front, start=1):
        _write(found, trial, title, folder / f"{number:03d}.yaml")
    return files


def as_json(found: Findings) -> dict[str, Any]:
    """Return the findings, ready for JSON."""

    def trial_json(trial: FrozenTrial) -> dict[str, Any]:
        score = asdict(score_of(trial))
        return {"trial": trial.number, "settings": found.values(trial), "score": score}

    return {
        "objectives": list(found.tuning.objectives),
        "trials": found.trials,
        "unstable": found.unstable,
        "refused": found.refused,
        "before": asdict(found.before),
        "best": None if found.best is None else trial_json(found.best),
        "front": [trial_json(trial) for trial in found.front],
        "importance": {
            item.name: found.importance.get(item.name, float("nan"))
            for item in (_ranked(found) if found.best is not None else ())
        },
    }


def _write(found: Findings, trial: FrozenTrial, title: str, file: FilePath) -> FilePath:
    score = score_of(trial)
    numbers = ", ".join(
        f"{name} {score.objectives[name]:.5g} (before: {found.before.objectives[name]:.5g})"
        for name in found.tuning.objectives
    )
    comment = f"Found by adp tune {__version__} for {title}, trial {trial.number}: {numbers}."
    settings = found.settings(trial)
    write_settings(file, settings, comment, found.values(trial))
    if load_settings(Settings, "path_follower", file) != settings:
        raise AdpError(f"file {file} reads back as other settings than those written to it")
    return file


def _compromise(front: list[FrozenTrial]) -> FrozenTrial | None:
    """Return the trial nearest to the best of each objective, each by its spread on the front."""
    if not front:
        return None
    points = np.array([trial.values for trial in front])
    spread = np.maximum(np.ptp(points, axis=0), 1e-12)
    distance = np.linalg.norm((points - points.min(axis=0)) / spread, axis=1)
    return front[int(np.argmin(distance))]


def _importance(tuning: Tuning, stable: list[FrozenTrial]) -> dict[str, float]:
    """Return the importance of each variation for the first objective, among stable trials."""
    if len(tuning.variations) == 1:
        return {tuning.variations[0].name: 1.0}
    if len(stable) < _LEAST_TRIALS:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Optuna warns of experimental features
        study = optuna.create_study()
        for trial in stable:
            study.add_trial(
                optuna.trial.create_trial(
                    params=trial.params, distributions=trial.distributions, value=trial.values[0]
                )
            )
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        found = optuna.importance.get_param_importances(study, evaluator=evaluator)
    return {name: float(share) for name, share in found.items()}


def _ranked(found: Findings) -> list[Variation]:
    return sorted(found.tuning.variations, key=lambda item: -found.importance.get(item.name, 0.0))


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
    numbers: dict[str, Callable[[Score], float]] = {
        f"{unit}, mean": lambda score: score.objectives["cost"],
        f"{unit}, median": lambda score: score.median,
        f"{unit}, 95 %": lambda score: score.high,
        f"{unit}, greatest": lambda score: score.largest,
        "effort, mean": lambda score: score.objectives["effort"],
        "cross-track RMS [m]": lambda score: score.objectives["cross_track"],
        "cross-track, greatest [m]": lambda score: score.objectives["worst_cross_track"],
    }
    rows: list[tuple[str, ...]] = [("", "before", "found")]
    for name, of in numbers.items():
        cells = [f"{value:.4f}" if value < 1e6 else "–" for value in (of(before), of(best))]
        rows.append((name, *cells))
    rows.append(("unstable runs", str(before.unstable), str(best.unstable)))
    return "\n".join(f"{name:28}{first:>12}{last:>12}" for name, first, last in rows)


def _importance_lines(found: Findings, best: FrozenTrial) -> list[str]:
    """Return a table of the variations: importance, values before and found, and good values."""
    base, values = flatten(found.tuning.conditions.settings), found.values(best)
    good = found.stable[: max(3, int(_BEST_SHARE * len(found.stable)))]
    rows = [("setting", "matters", "before", "found", "the best tenth has")]
    for item in _ranked(found):
        share = found.importance.get(item.name)
        before = base[item.field.name]
        rows.append(
            (
                item.name,
                "–" if share is None else f"{100.0 * share:.0f} %",
                shown(before if isinstance(item, Listed) else item.number_in(before)),
                shown(values[item.name]),
                _where(item, [found.values(trial)[item.name] for trial in good])
                + ("  (at the end of its range: widen it?)" * _is_at_end(item, values[item.name])),
            )
        )
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=False))
        + f"  {row[4]}"
        for row in rows
    ]
