"""The first screen of a page: the verdict on a run in a sentence, and its chief numbers."""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.analysis.bag_analysis import NOT_MEASURED, BagAnalysis, number
from adp_path_follower.core.geometry import FloatArray

_OFF = 0.5  # [m] from which on a robot is off its path
_EARLY, _LATE = 0.5, 0.25  # [s] at the beginning, share of the run at the end
_MOST = 1e9  # a Bellman error beyond it is that of a damaged message


@dataclass(frozen=True)
class Headline:
    """The verdict on a run, and its chief numbers as (name, value, explanation)."""

    name: str
    good: bool
    verdict: str
    cards: tuple[tuple[str, str, str], ...]


def headline(analysis: BagAnalysis) -> Headline:
    """Return the first screen of the page of a run."""
    metrics = analysis.metrics
    faults = sum(event.kind == "fault" for event in analysis.events)
    distance, farthest = metrics["steady_cross_track_rms"], metrics["steady_cross_track_max"]
    on_path = not farthest > _OFF
    sentences = [f"{number(metrics['path_covered'], 4)} m of the path were driven"]
    if math.isfinite(distance):
        sentences.append(f"{_millimetres(distance)} from it (root mean square, when settled)")
    if math.isfinite(metrics["cost_ratio"]):
        percent = 100.0 * (metrics["cost_ratio"] - 1.0)
        sentences.append(f"at {percent:.3g} % more than the least possible cost")
    ending = "no fault" if not faults else f"{faults} fault{'s' * (faults > 1)}"
    cards = (
        _cost_card(metrics["cost_ratio"], metrics["cost"]),
        (
            "distance from the path",
            _millimetres(distance),
            f"at most {_millimetres(farthest)}; root mean square, when settled",
        ),
        ("settled after", _with_unit(metrics["settling_time"], "s"), "error below 0.05 from then"),
        _learned_card(analysis),
        ("robot model", _text(analysis, "robot_model"), "of the controller"),
        ("faults", str(faults), _times(analysis)),
    )
    verdict = f"{', '.join(sentences)}; {ending}."
    return Headline(analysis.name, on_path and not faults, verdict, cards)


def _cost_card(ratio: float, cost: float) -> tuple[str, str, str]:
    if math.isfinite(ratio):
        return "J / J*", number(ratio, 5), "cost beside the least possible; 1 is the best"
    return "cost J", number(cost, 5), "no optimum to compare it with"


def _learned_card(analysis: BagAnalysis) -> tuple[str, str, str]:
    """Return how far the Bellman error has come down while driving."""
    panels = analysis.charts.panels.get("bellman_error")
    if not panels:
        return "learned", NOT_MEASURED, "the bag has no Bellman error"
    line = panels[0].lines[0]
    known = np.isfinite(line.values) & (line.time >= 0.0) & (line.values < _MOST)
    time, values = line.time[known], line.values[known]
    if not len(time):
        return "learned", NOT_MEASURED, "the bag has no Bellman error while driving"
    late = time >= time[-1] - _LATE * (time[-1] - time[0])
    begun, ended = _middle(values[time <= time[0] + _EARLY]), _middle(values[late])
    return "learned", f"{begun:.1e} → {ended:.1e}", "Bellman error, at first and at the end"


def _text(analysis: BagAnalysis, name: str) -> str:
    """Return a setting as text without quotation marks."""
    return analysis.settings.get(name, NOT_MEASURED).strip("\"'")


def _middle(values: FloatArray) -> float:
    return float(np.median(values))


def _times(analysis: BagAnalysis) -> str:
    halted = sum(float(np.diff(spans, axis=1).sum()) for spans in analysis.charts.halts.values())
    return f"{halted:.3g} s waiting or stopped" if halted else "never stopped on the way"


def _millimetres(value: float) -> str:
    return _with_unit(1e3 * value, "mm")


def _with_unit(value: float, unit: str) -> str:
    return f"{number(value, 3)} {unit}" if math.isfinite(value) else NOT_MEASURED
