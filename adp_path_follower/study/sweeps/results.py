"""Results of a sweep or a tuning: the best settings, their gain, and the settings that matter."""

import json
import warnings
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import optuna
from optuna.trial import FrozenTrial, create_trial

from adp_path_follower import __version__
from adp_path_follower.core.files import output_to, write_output
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import parameter_file_text
from adp_path_follower.core.settings.schema import Value, flatten
from adp_path_follower.study.sweeps.objectives import Score
from adp_path_follower.study.sweeps.ranges import Listed, Range, Variation
from adp_path_follower.study.sweeps.request import Request, Tuning
from adp_path_follower.study.sweeps.study import baseline, refused, score_of, tried

_LEAST_TRIALS = 20  # fewer do not tell how much a setting matters
_BEST_SHARE = 0.1  # of the trials: the good ones


@dataclass(frozen=True)
class Results:
    """Results of a sweep, whose trials are its combinations, or of a tuning."""

    request: Request  # the sweep or the tuning
    before: Score | None  # score of the settings before, of a tuning
    trials: tuple[FrozenTrial, ...]  # all that were judged
    # Trials that are stable on every run, the best first by the first objective.
    stable: tuple[FrozenTrial, ...]
    # Stable trials that no other trial dominates; one trial for a single objective.
    front: tuple[FrozenTrial, ...]
    # The first stable trial of a sweep; the trial of a tuning's front with the most even
    # compromise; None if no trial is stable.
    best: FrozenTrial | None
    # Variations, the most important first -> share in what tells the best trials from the others
    # (PED-ANOVA), from 0 to 1; None for too few trials.
    importance: dict[Variation, float | None]
    refused: dict[str, int]  # sentence -> number of settings that the validation rejected with it

    @property
    def unstable(self) -> int:
        """Return the number of trials with an unstable run."""
        return len(self.trials) - len(self.stable)

    @property
    def problems(self) -> dict[str, int]:
        """Return sentence -> number of trials with runs that were impossible for this reason."""
        return dict(Counter(filter(None, (score_of(trial).problem for trial in self.trials))))

    @property
    def relative(self) -> bool:
        """Return whether all costs are J/J*; J otherwise."""
        return all(score_of(trial).relative for trial in self.trials)

    def values(self, trial: FrozenTrial) -> dict[str, Value]:
        """Return the values of a trial, by the names of the variations."""
        return self.request.values(trial.params)

    def settings(self, trial: FrozenTrial) -> Settings:
        """Return the settings of a trial."""
        return self.request.settings_with(self.values(trial))


def results(study: optuna.Study, request: Request) -> Results:
    """Return the results of a study."""
    trials = tried(study)
    stable = [trial for trial in trials if not score_of(trial).unstable]
    stable.sort(key=lambda trial: trial.values[0])
    front = sorted(study.best_trials, key=lambda trial: tuple(trial.values))
    if len(study.directions) == 1:
        front = front[:1]
    return Results(
        request=request,
        before=baseline(study),
        trials=tuple(trials),
        stable=tuple(stable),
        front=tuple(front),
        best=_compromise(front) if isinstance(request, Tuning) else next(iter(stable), None),
        importance=_importance(request, stable),
        refused=dict(Counter(refused(study))),
    )


def results_text(found: Results) -> str:
    """Return the results in words and a table."""
    objectives = " and ".join(found.request.objectives)
    lines = [
        f"{len(found.trials):,} settings tried for {objectives}, on "
        f"{found.request.conditions.runs:,} runs each; {found.unstable:,} unstable in some run; "
        f"{sum(found.refused.values()):,} rejected before any run"
    ]
    lines += [f"  rejected {count} times: {text}" for text, count in found.refused.items()][:3]
    lines += [f"  {count} could not run: {text}" for text, count in found.problems.items()][:3]
    if found.before is not None and found.before.problem:
        lines.append(f"the settings before cannot run: {found.before.problem}")
    if found.best is None:
        lines.append("no settings are stable in all runs: change what varies, or try more")
        return "\n".join(lines)
    best = score_of(found.best)
    lines += ["", _table(found.before, best)]
    if found.before is not None and not found.before.unstable:
        scores = best.objectives, found.before.objectives
        if all(scores[0][name] >= scores[1][name] for name in found.request.objectives):
            lines.append("Nothing is better than the settings before.")
    if len(found.front) > 1:
        chosen = "the most even compromise" if isinstance(found.request, Tuning) else "the first"
        lines.append(f"{len(found.front)} settings are on the Pareto front; these are {chosen}")
    lines += ["", *_importance_lines(found, found.best)]
    return "\n".join(lines)


def write_results(found: Results, title: str, directory: FilePath) -> None:
    """Write best settings and front anew as parameter files, and all numbers as JSON.

    Raises FileError if something cannot be written.
    """
    best, folder = directory / "best.yaml", directory / "front"
    front = found.front if len(found.front) > 1 else ()
    with output_to(best):
        if found.best is None:
            best.unlink(missing_ok=True)
        else:
            _write(found, found.best, title, best)
    with output_to(folder):
        if front:
            folder.mkdir(exist_ok=True)
        for file in folder.glob("*.yaml"):
            if file.stem.isdigit() and int(file.stem) > len(front):
                file.unlink()
    for number, trial in enumerate(front, start=1):
        _write(found, trial, title, folder / f"{number:03d}.yaml")
    write_output(directory / "findings.json", json.dumps(_as_json(found), indent=2) + "\n")


def shown(value: Value) -> str:
    """Return a value in few digits."""
    if isinstance(value, tuple):
        return "[" + ", ".join(shown(item) for item in value) + "]"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _as_json(found: Results) -> dict[str, Any]:
    def trial_json(trial: FrozenTrial) -> dict[str, Any]:
        score = asdict(score_of(trial))
        return {"trial": trial.number, "settings": found.values(trial), "score": score}

    return {
        "objectives": found.request.objectives,
        "trials": len(found.trials),
        "unstable": found.unstable,
        "refused": found.refused,
        "before": found.before and asdict(found.before),
        "best": found.best and trial_json(found.best),
        "front": [trial_json(trial) for trial in found.front],
        "importance": {item.name: share for item, share in found.importance.items()},
    }


def _write(found: Results, trial: FrozenTrial, title: str, file: FilePath) -> None:
    """Write a trial's settings as a parameter file with a comment; may raise FileError."""
    score = score_of(trial)
    numbers = [f"{name} {score.objectives[name]:.5g}" for name in found.request.objectives]
    if found.before is not None:
        before = found.before.objectives
        numbers = [
            f"{text} (before: {before[name]:.5g})"
            for text, name in zip(numbers, found.request.objectives, strict=True)
        ]
    varied = ", ".join(f"{name}: {shown(value)}" for name, value in found.values(trial).items())
    comment = (
        f"# Found by adp_path_follower {__version__} for {title}, trial {trial.number}: "
        f"{', '.join(numbers)}.\n# Varied: {varied or 'nothing'}.\n"
    )
    write_output(file, comment + parameter_file_text(found.settings(trial), "path_follower"))


def _compromise(front: list[FrozenTrial]) -> FrozenTrial | None:
    """Return the trial nearest to the best of each objective, each by its spread on the front."""
    if not front:
        return None
    points = np.array([trial.values for trial in front])
    spread = np.maximum(np.ptp(points, axis=0), 1e-12)
    distance = np.linalg.norm((points - points.min(axis=0)) / spread, axis=1)
    return front[int(np.argmin(distance))]


def _importance(request: Request, stable: list[FrozenTrial]) -> dict[Variation, float | None]:
    """Return the importance of each variation for the first objective, among stable trials."""
    found: dict[str, float] = {}
    if len(request.variations) == 1:
        found = {request.variations[0].name: 1.0}
    elif len(stable) >= _LEAST_TRIALS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Optuna warns of experimental features
            study = optuna.create_study()
            study.add_trials(
                create_trial(
                    params=trial.params, distributions=trial.distributions, value=trial.values[0]
                )
                for trial in stable
            )
            evaluator = optuna.importance.PedAnovaImportanceEvaluator()
            found = optuna.importance.get_param_importances(study, evaluator=evaluator)
    ranked = sorted(request.variations, key=lambda item: -found.get(item.name, 0.0))
    return {item: found.get(item.name) for item in ranked}


def _where(item: Variation, values: list[Value]) -> str:
    if isinstance(item, Listed):
        commonest = max(item.values, key=values.count)
        return f"{shown(commonest)} in {values.count(commonest)} of {len(values)}"
    numbers = np.array(values, dtype=float)
    return f"{numbers.min():.4g} to {numbers.max():.4g}"


def _table(before: Score | None, best: Score) -> str:
    unit = "J/J*" if best.relative else "J"
    names = {
        "cost": f"{unit}, mean",
        "median": f"{unit}, median",
        "high": f"{unit}, 95 %",
        "worst_case": f"{unit}, greatest",
        "effort": "effort, mean",
        "cross_track": "cross-track RMS [m]",
        "worst_cross_track": "cross-track, greatest [m]",
    }
    columns = {"found": best} if before is None else {"before": before, "found": best}
    rows = [("", *columns)]
    for key, name in names.items():
        values = [{**vars(score), **score.objectives}[key] for score in columns.values()]
        rows.append((name, *(f"{value:.4f}" if value < 1e6 else "–" for value in values)))
    rows.append(("unstable runs", *(str(score.unstable) for score in columns.values())))
    return "\n".join(f"{name:28}" + "".join(f"{cell:>12}" for cell in row) for name, *row in rows)


def _importance_lines(found: Results, best: FrozenTrial) -> list[str]:
    """Return a table of the variations: importance, values before and found, and good values."""
    base, values = flatten(found.request.conditions.settings), found.values(best)
    good = found.stable[: max(3, int(_BEST_SHARE * len(found.stable)))]
    rows = [("setting", "matters", "before", "found", "the best tenth has")]
    for item, share in found.importance.items():
        best_value, theirs = values[item.name], [found.values(trial)[item.name] for trial in good]
        where = _where(item, theirs)
        if isinstance(item, Range) and item.is_at_end(best_value):
            where += "  (at the end of its range: widen it?)"
        matters = "–" if share is None else f"{100.0 * share:.0f} %"
        before = shown(item.before(base[item.field.name]))
        rows.append((item.name, matters, before, shown(best_value), where))
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=False))
        + f"  {row[4]}"
        for row in rows
    ]
