"""The Optuna study of a tuning: proposes settings and stores the trials."""

import warnings
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)
from optuna.trial import FrozenTrial, Trial, TrialState

from adp_path_follower.core.errors import AdpError, SettingsError
from adp_path_follower.core.settings.schema import Value, flatten, yaml_text
from adp_path_follower.study.sweeps.request.objectives import Score, score_of_runs
from adp_path_follower.study.sweeps.request.ranges import Listed, Variation
from adp_path_follower.study.sweeps.request.request import Sweep, Tuning
from adp_path_follower.study.sweeps.workers.cluster import Workers
from adp_path_follower.study.sweeps.workers.plan import Plan, work_off
from adp_path_follower.study.sweeps.workers.runs import joined

_BASELINE = "baseline"
_SCORE = "score"
_REFUSED = "refused"
_MOST_REFUSED = 50  # one after the other: then the ranges hold nothing valid


def open_study(tuning: Tuning, storage: str, shared: bool) -> optuna.Study:
    """Return the study of a tuning, which is made if it is missing.

    `storage` is the address of a database, as in "sqlite:///study.db" or "postgresql://...";
    `shared` says that other commands may work on the same study. Raises AdpError if the database
    cannot be used.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        study = optuna.create_study(
            storage=storage,
            study_name=f"adp_tune_{tuning.digest[:16]}",
            directions=["minimize"] * len(tuning.objectives),
            load_if_exists=True,
        )
        before = study.get_trials(deepcopy=False)
    except Exception as error:  # drivers of databases have no common error
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise AdpError(
            f"storage '{storage}' cannot be used ({reason}): give an address like "
            "sqlite:///study.db or postgresql://user@host/name, and install the driver of the "
            "database"
        ) from None
    if not shared:
        for trial in before:
            if not trial.state.is_finished():  # its command was killed
                study.tell(trial.number, state=TrialState.FAIL)
    # A study that goes on, or that others work on too, must not draw the same again.
    seed = None if shared else tuning.search.seed + len(before)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Optuna warns of experimental features
        study.sampler = optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True)
    return study


def tune(
    study: optuna.Study, tuning: Tuning, workers: Workers, progress: Callable[[float], None]
) -> None:
    """Try settings until the study has as many trials as are asked for.

    The number of trials at once is that of the tuning, and they are judged in the order in which
    they began, so that proposals do not depend on the speed of the workers. Raises AdpError if the
    workers fail, or if the ranges hold no valid settings.
    """
    _judge_baseline(study, tuning, workers)
    distributions = {item.name: _distribution(item) for item in tuning.variations}
    under_way: deque[tuple[Trial, Any]] = deque()
    while True:
        done = len(tried(study))
        progress(min(1.0, done / tuning.search.trials))
        while (
            done + len(under_way) < tuning.search.trials and len(under_way) < tuning.search.at_once
        ):
            trial, sweep = _propose(study, tuning, distributions)
            under_way.append((trial, workers.begin(score_runs, sweep)))
        if not under_way:
            return
        trial, future = under_way.popleft()
        _tell(study, trial, workers.result(future), tuning)


def score_runs(sweep: Sweep) -> Score:
    """Simulate the runs of a sweep of one combination, on a worker."""
    plan = Plan(sweep)
    return score_of_runs(joined([work_off(plan.part(number)) for number in range(plan.parts)]))


def tried(study: optuna.Study) -> list[FrozenTrial]:
    """Return the trials that were judged."""
    return study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))


def refused(study: optuna.Study) -> list[str]:
    """Return why settings were rejected before any run, one sentence for each."""
    trials = study.get_trials(deepcopy=False, states=(TrialState.PRUNED,))
    return [str(trial.user_attrs.get(_REFUSED, "")) for trial in trials]


def score_of(trial: FrozenTrial) -> Score:
    """Return what the runs of a trial said."""
    return Score(**trial.user_attrs[_SCORE])


def baseline(study: optuna.Study) -> Score:
    """Return what the runs with the settings before said."""
    return Score(**study.user_attrs[_BASELINE])


def values_of(tuning: Tuning, params: Mapping[str, Any]) -> dict[str, Value]:
    """Return the values of a trial's parameters, by the names of what is varied."""
    values: dict[str, Value] = {}
    for item in tuning.variations:
        given = params[item.name]
        if isinstance(item, Listed):
            values[item.name] = item.values[_labels(item).index(str(given))]
        else:
            values[item.name] = int(given) if item.integer else float(given)
    return values


def _propose(
    study: optuna.Study, tuning: Tuning, distributions: dict[str, BaseDistribution]
) -> tuple[Trial, Any]:
    """Return a trial and its runs; settings that the validation rejects are not run."""
    reason = ""
    for _ in range(_MOST_REFUSED):
        trial = study.ask(distributions)
        try:
            values = values_of(tuning, trial.params)
            return trial, tuning.runs_with(tuning.settings_with(values))
        except SettingsError as error:
            reason = str(error)
            trial.set_user_attr(_REFUSED, reason)
            study.tell(trial, state=TrialState.PRUNED)
    raise AdpError(
        f"the ranges hold hardly any settings that are allowed: {reason}; change the ranges"
    )


def _tell(study: optuna.Study, trial: Trial, score: Score, tuning: Tuning) -> None:
    trial.set_user_attr(_SCORE, asdict(score))
    # Above 0 it is no candidate, whatever its cost.
    trial.set_constraint("unstable runs", float(score.unstable))
    study.tell(trial, [score.objectives[name] for name in tuning.objectives])


def _judge_baseline(study: optuna.Study, tuning: Tuning, workers: Workers) -> None:
    """Try the settings before: what is found must be better than they are."""
    if _BASELINE in study.user_attrs:
        return
    score = workers.result(workers.begin(score_runs, tuning.runs_with(tuning.conditions.settings)))
    study.set_user_attr(_BASELINE, asdict(score))
    base = flatten(tuning.conditions.settings)
    params = {item.name: _base_value(item, base) for item in tuning.variations}
    if None not in params.values() and not study.get_trials(deepcopy=False):
        study.enqueue_trial(params)
        distributions = {item.name: _distribution(item) for item in tuning.variations}
        _tell(study, study.ask(distributions), score, tuning)


def _base_value(item: Variation, base: dict[str, Value]) -> Any:
    """Return the value before, as Optuna has it; None if it is not among those to try."""
    value = base[item.field.name]
    if isinstance(item, Listed):
        return yaml_text(value) if value in item.values else None
    number = item.number_in(value)
    return number if item.low <= number <= item.high else None


def _distribution(item: Variation) -> BaseDistribution:
    if isinstance(item, Listed):
        return CategoricalDistribution(_labels(item))
    if item.integer:
        return IntDistribution(int(item.low), int(item.high), log=item.log)
    return FloatDistribution(item.low, item.high, log=item.log)


def _labels(item: Listed) -> list[str]:
    return [yaml_text(value) for value in item.values]
