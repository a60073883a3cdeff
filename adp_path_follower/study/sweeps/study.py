"""The Optuna study of a sweep or a tuning: holds what was tried, and proposes what to try."""

import warnings
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict
from typing import Any

import optuna
from optuna.trial import FrozenTrial, Trial, TrialState, create_trial

from adp_path_follower.core.errors import AdpError, SettingsError
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import flatten
from adp_path_follower.study.sweeps.cluster import Workers
from adp_path_follower.study.sweeps.objectives import Score
from adp_path_follower.study.sweeps.request import Sweep, Tuning
from adp_path_follower.study.sweeps.runs import score_settings

_BASELINE = "baseline"
_SCORE = "score"
_REFUSED = "refused"
_UNSTABLE = "unstable runs"  # the constraint: above 0 it is no candidate, whatever its cost
_FRONT = 2  # objectives of a sweep that make its Pareto front
_MOST_REFUSED = 50  # one after the other: then the ranges hold nothing valid


def sweep_study(sweep: Sweep, scores: Iterable[Score]) -> optuna.Study:
    """Return a study in memory with the scores of a sweep's combinations, in their order."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    objectives = sweep.objectives[:_FRONT]
    study = optuna.create_study(directions=["minimize"] * len(objectives))
    distributions = sweep.distributions
    for number, score in enumerate(scores):
        varied = sweep.varied(number)
        study.add_trial(
            create_trial(
                values=[score.objectives[name] for name in objectives],
                params={item.name: item.parameter(varied[item.name]) for item in sweep.variations},
                distributions=distributions,
                user_attrs={_SCORE: asdict(score)},
                constraints={_UNSTABLE: float(score.unstable)},
            )
        )
    return study


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
    under_way: deque[tuple[Trial, Any]] = deque()
    while True:
        done = len(tried(study))
        progress(min(1.0, done / tuning.search.trials))
        while (
            done + len(under_way) < tuning.search.trials and len(under_way) < tuning.search.at_once
        ):
            trial, settings = _propose(study, tuning)
            under_way.append((trial, workers.begin(score_settings, tuning.conditions, settings)))
        if not under_way:
            return
        trial, future = under_way.popleft()
        _tell(study, trial, workers.result(future), tuning)


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


def baseline(study: optuna.Study) -> Score | None:
    """Return what the runs with the settings before said, None for a sweep."""
    found = study.user_attrs.get(_BASELINE)
    return None if found is None else Score(**found)


def _propose(study: optuna.Study, tuning: Tuning) -> tuple[Trial, Settings]:
    """Return a trial and its settings; those that the validation rejects are not run."""
    reason = ""
    for _ in range(_MOST_REFUSED):
        trial = study.ask(tuning.distributions)
        try:
            return trial, tuning.settings_with(tuning.values(trial.params))
        except SettingsError as error:
            reason = str(error)
            trial.set_user_attr(_REFUSED, reason)
            study.tell(trial, state=TrialState.PRUNED)
    raise AdpError(
        f"the ranges hold hardly any settings that are allowed: {reason}; change the ranges"
    )


def _tell(study: optuna.Study, trial: Trial, score: Score, tuning: Tuning) -> None:
    trial.set_user_attr(_SCORE, asdict(score))
    trial.set_constraint(_UNSTABLE, float(score.unstable))
    study.tell(trial, [score.objectives[name] for name in tuning.objectives])


def _judge_baseline(study: optuna.Study, tuning: Tuning, workers: Workers) -> None:
    """Try the settings before: what is found must be better than they are."""
    if _BASELINE in study.user_attrs:
        return
    before = tuning.conditions.settings
    score = workers.result(workers.begin(score_settings, tuning.conditions, before))
    study.set_user_attr(_BASELINE, asdict(score))
    params = tuning.parameters(flatten(before))
    if None not in params.values() and not study.get_trials(deepcopy=False):
        study.enqueue_trial(params)
        _tell(study, study.ask(tuning.distributions), score, tuning)
