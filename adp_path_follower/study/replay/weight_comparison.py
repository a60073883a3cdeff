"""Compares the weights that a controller recorded with those of a replay."""

from dataclasses import dataclass

import numpy as np

from adp_path_follower.bags.columns import Series
from adp_path_follower.bags.reader import Run
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.study.replay.replay import Replay

_KINDS = ("critic", "actor")


@dataclass(frozen=True)
class WeightDifference:
    """Where recorded and replayed weights first differ."""

    step: int  # number of the control step
    name: str  # weight that differs most in it, as "critic weight s²"
    recorded: float  # in the bag
    replayed: float  # in the replay


@dataclass(frozen=True)
class ComparedWeights:
    """How recorded and replayed weights compare."""

    # For each recorded set whether it comes out the same to the last bit, those of the critic
    # first, shape (N,); no rows where there is nothing to compare.
    identical: np.ndarray
    first: WeightDifference | None  # the first difference, None without one
    notes: tuple[str, ...]  # sentences about data that were not compared


def compare_weights(run: Run, found: Replay) -> ComparedWeights:
    """Return how the weights in a run compare with those of its replay."""
    same: list[np.ndarray] = []
    differences: list[WeightDifference] = []
    notes: list[str] = []
    for kind in _KINDS:
        recorded = run.series.get(f"{kind}_weights")
        if recorded is None:
            continue
        replayed = np.array([getattr(output.weights, kind) for output in found.outputs])
        count, columns = recorded.values.shape
        if columns != replayed.shape[1]:
            same.append(np.zeros(count, dtype=bool))
            name = f"number of {kind} weights"
            differences.append(WeightDifference(0, name, columns, replayed.shape[1]))
        elif count > len(replayed):
            notes.append(
                f"the bag has {count} sets of {kind} weights for {len(replayed)} steps: not "
                "compared, as it is not known which belong together"
            )
        else:
            steps, equal = _matched(recorded, replayed, found.steps.arrival)
            same.append(equal)
            if not equal.all():
                row = int(np.argmin(equal))
                step = int(steps[row])
                differences.append(
                    _difference(kind, step, recorded.labels, recorded.values[row], replayed[step])
                )
    first = min(differences, key=lambda item: item.step, default=None)
    identical = np.concatenate(same) if same else np.zeros(0, dtype=bool)
    return ComparedWeights(identical, first, tuple(notes))


def _matched(
    recorded: Series, replayed: FloatArray, arrival: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the step that each recorded set belongs to, and whether both are the same, (N,) each.

    Weights carry no stamp: a set belongs to the next step with the same, else to the last pose
    before.
    """
    values = recorded.values
    if len(values) == len(replayed):
        return np.arange(len(values)), np.asarray((values == replayed).all(axis=1))
    steps = np.searchsorted(arrival, recorded.arrival, side="right") - 1
    steps = np.clip(steps, 0, len(replayed) - 1)
    same = np.zeros(len(values), dtype=bool)
    places: dict[bytes, list[int]] = {}
    for step in reversed(range(len(replayed))):  # so that the earliest comes off the end
        places.setdefault((replayed[step] + 0.0).tobytes(), []).append(step)  # -0.0 is 0.0
    following = 0
    for row, value in enumerate(values):
        fitting = places.get((value + 0.0).tobytes(), [])
        while fitting and fitting[-1] < following:
            fitting.pop()
        if fitting:
            steps[row], same[row] = fitting[-1], True
            following = fitting[-1] + 1
    return steps, same


def _difference(
    kind: str, step: int, labels: tuple[str, ...], recorded: FloatArray, replayed: FloatArray
) -> WeightDifference:
    with np.errstate(all="ignore"):  # a damaged message may hold anything
        place = int(np.argmax(np.abs(recorded - replayed)))  # a NaN before all
    name = labels[place] if place < len(labels) else str(place + 1)
    return WeightDifference(
        step, f"{kind} weight {name}", float(recorded[place]), float(replayed[place])
    )
