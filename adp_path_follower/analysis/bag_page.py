"""The page about analysed bags: one file that opens without network."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from adp_path_follower.analysis.bag_analysis import NOT_MEASURED, BagAnalysis, number
from adp_path_follower.analysis.metrics import METRICS, Metric, Requirement
from adp_path_follower.analysis.run_charts import LEARNED
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.criteria import OFF_PATH, SETTLED
from adp_path_follower.drawing.charts import Charts, Track
from adp_path_follower.drawing.figure_style import color
from adp_path_follower.drawing.page import Card, write_page
from adp_path_follower.drawing.page_figures import page_data

CAPTIONS = {
    "track": (
        "Path and track",
        "The robot's track beside the path. The arrow is the robot at the time of the slider "
        "below, which “follow” keeps in sight.",
    ),
    "policy_before": (
        "The policy at the first step",
        "Turn rate that it commands for each distance y and angle θ to the path; red turns right.",
    ),
    "policy_after": (
        f"The policy {LEARNED:g} s later",
        "The same map with the weights that were learned by then.",
    ),
    "errors": (
        "Tracking errors",
        "Distance and angle to the nearest place of the path, positive to its left, from odometry "
        "and path alone.",
    ),
    "commands": ("Commands", "Commands that the robot received; each holds until the next."),
    "cost": ("Cost to date", "∫ eᵀQe + uᵀRu so far, as the controller counts it."),
    "weights": (
        "Critic and actor weights",
        "The largest by name, the others grey: the value function and the policy that are learned "
        "while driving.",
    ),
    "bellman_error": (
        "Bellman error",
        "How far the learned value function is from its own equation at the robot's place.",
    ),
    "excitation": (
        "Excitation certificate",
        "Smallest singular value of the rank condition: above 0, every weight is determined.",
    ),
    "robot_model": (
        "The robot's model",
        "Delay, lags, gains and bias that commands are for; grey is two standard deviations away, "
        "where driving tells them.",
    ),
    "robot_velocity": (
        "Velocities of robot and model",
        "Velocities that the encoders measured, and those that the last of these models expects.",
    ),
    "period": ("Control period", "How often each time between two commands occurred."),
    "latency": (
        "Latency",
        "From the arrival of an odometry message to that of the command that answers it, in the "
        "recorder.",
    ),
    "events": ("Events", "State changes, faults, parameter changes and new paths."),
}
_COLOR_CAPTION = (
    "Its colour is the distance from the path, and stays the same beyond the end of the scale."
)
_COSTS = ("cost", "cost_ratio", "bellman_error_rms")
_ON_ANY_PATH = ("command_", "latency_")  # how metrics begin that no path changes
_SAME_PATH = 0.05  # [m] between the points of two lines, beyond their spacing
_COST_OF = ("state_cost", "input_cost", "desired_speed", "target_gain")
_WHY = "“How far to trust the numbers” says why"
_EARLY, _LATE = 0.5, 0.25  # [s] at the beginning, share of the run at the end
_MOST = 1e9  # a Bellman error beyond it is that of a damaged message


@dataclass(frozen=True)
class Headline:
    """The verdict on a run, and its chief numbers as (name, value, explanation)."""

    name: str
    good: bool
    verdict: str
    cards: tuple[Card, ...]


def write_report(
    analyses: Sequence[BagAnalysis], requirements: Sequence[Requirement], file: FilePath
) -> None:
    """Write the page about one or several bags."""
    data = page_data(analyses)
    write_page(
        file,
        "report",
        data,
        title=", ".join(analysis.name for analysis in analyses),
        analyses=analyses,
        headlines=[_headline(analysis) for analysis in analyses],
        colors=[color(index) for index in range(len(analyses))],
        rows=_rows(analyses),
        states=sorted({state for analysis in analyses for state in analysis.states}),
        settings=_settings(analyses),
        checks=[
            (requirement, analysis, number(analysis.numbers.get(requirement.name, math.nan)))
            for requirement in requirements
            for analysis in analyses
        ],
        captions=_captions(analyses, data["figures"]),
        number=number,
        nan=math.nan,
    )


def _captions(
    analyses: Sequence[BagAnalysis], figures: Mapping[str, Any]
) -> list[tuple[str, str, str]]:
    """Return key, title and caption of each figure; nothing is said of what no bag has."""
    bags = [analysis.charts for analysis in analyses]
    return [
        (key, title, " ".join([text, *_details(key, bags)]))
        for key, (title, text) in CAPTIONS.items()
        if key in figures
    ]


def _details(key: str, bags: Sequence[Charts]) -> list[str]:
    """Return what more is said of a figure, as far as it is true of one of the bags."""
    found = []
    if key == "track":
        if len(bags) == 1:
            found.append(_COLOR_CAPTION)
        if any(np.isfinite(charts.track.target).any() for charts in bags):
            found.append("The ring is its virtual target.")
        if len(bags) == 1 and bags[0].optimum is not None:  # beside several runs it is not drawn
            found.append("The orange arrow is the optimum from the same start.")
    panels = [charts.panels.get(key, ()) for charts in bags]
    if key == "errors" and max(map(len, panels)) > 2:
        found.append("s is how far the robot is ahead of its virtual target.")
    limits = [limit for of_bag in panels for panel in of_bag for limit in panel.limits]
    if key == "commands" and np.isfinite(limits).any():
        found.append("The dashed lines are the limits.")
    return found


def _rows(analyses: Sequence[BagAnalysis]) -> list[tuple[Metric, list[tuple[str, bool]]]]:
    """Return the table of metrics: a cell for each bag, and whether it is the best."""
    rows, on_one_path = [], _on_one_path(analyses)
    for metric in METRICS:
        texts = [number(analysis.metrics[metric.name], 5) for analysis in analyses]
        best = _best(metric, analyses, on_one_path)
        # No star where two share the best value as it is printed.
        stars = [place == best and texts.count(text) == 1 for place, text in enumerate(texts)]
        rows.append((metric, list(zip(texts, stars, strict=True))))
    return rows


def _best(metric: Metric, analyses: Sequence[BagAnalysis], on_one_path: bool) -> int:
    """Return which bag has the best value, -1 where none has or they cannot be compared."""
    values = np.array([analysis.metrics[metric.name] for analysis in analyses])
    # Costs are compared where all bags name the same Q, R and speed along the path.
    asked = {tuple(item.settings.get(name, "") for name in _COST_OF) for item in analyses}
    comparable = metric.name not in _COSTS or len(asked) == 1
    comparable &= metric.name.startswith(_ON_ANY_PATH) or on_one_path
    doubted = any(analysis.trust.doubt(metric.name) for analysis in analyses)
    if not metric.better or doubted or not comparable or np.isfinite(values).sum() < 2:
        return -1
    return int(np.nanargmin(values) if metric.better == "low" else np.nanargmax(values))


def _on_one_path(analyses: Sequence[BagAnalysis]) -> bool:
    """Return whether all bags have the same path, within the spacing of the points kept."""
    lines = [analysis.charts.track.path for analysis in analyses]
    first, *others = [line[np.isfinite(line).all(axis=1)] for line in lines]

    def near(line: FloatArray, other: FloatArray) -> bool:
        if not (len(line) and len(other)):
            return len(line) == len(other)
        spacing = np.median(np.hypot(*np.diff(other, axis=0).T)) if len(other) > 1 else 0.0
        return bool(cKDTree(other).query(line)[0].max() <= spacing + _SAME_PATH)

    return all(near(first, line) and near(line, first) for line in others)


def _settings(analyses: Sequence[BagAnalysis]) -> list[tuple[str, list[str], bool]]:
    """Return name, value in each bag, and whether they differ."""
    names: dict[str, Any] = {}
    for analysis in analyses:
        names |= dict.fromkeys(analysis.settings)
    rows = []
    for name in names:
        values = [analysis.settings.get(name, "–") for analysis in analyses]
        rows.append((name, values, len({value for value in values if value != "–"}) > 1))
    return rows


def _headline(analysis: BagAnalysis) -> Headline:
    """Return the first screen of the page of a run."""
    metrics = analysis.metrics
    faults = sum(event.kind == "fault" for event in analysis.events)
    distance, farthest = metrics["steady_cross_track_rms"], metrics["steady_cross_track_max"]
    path = _path_of(analysis.charts.track)
    sentences = [f"{number(metrics['path_covered'], 4)} m of {path} were driven"]
    if not analysis.trust.compared:
        sentences = [f"{number(metrics['distance'], 4)} m were driven, not compared with the path"]
    if math.isfinite(distance):
        sentences.append(f"{_millimetres(distance)} from it (root mean square, after the start)")
    if math.isfinite(metrics["cost_ratio"]):
        percent = 100.0 * (metrics["cost_ratio"] - 1.0)
        sentences.append(f"at {percent:.3g} % more than the least possible cost")
    model = analysis.settings.get("robot_model", NOT_MEASURED)
    ending = "no fault" if not faults else f"{faults} fault{'s' * (faults > 1)}"
    cards = (
        _cost_card(metrics["cost_ratio"], metrics["cost"]),
        (
            "distance from the path",
            _millimetres(distance),
            f"at most {_millimetres(farthest)}; root mean square, after the start",
        ),
        (
            "settled after",
            _with_unit(metrics["settling_time"], "s"),
            f"error below {SETTLED:g} from then",
        ),
        _learned_card(analysis),
        ("robot model", model.strip("\"'"), "of the controller"),
        ("faults", str(faults), _halted(analysis)),
    )
    verdict = f"{', '.join(sentences)}; {ending}."
    return Headline(analysis.name, farthest <= OFF_PATH and not faults, verdict, cards)


def _path_of(track: Track) -> str:
    """Return the path in words: a bag has its points but not its name, so its length tells it."""
    if np.isnan(track.path).any():
        return "several paths"
    length = float(np.hypot(*np.diff(track.path, axis=0).T).sum())
    return f"the path of {number(length, 4)} m"


def _cost_card(ratio: float, cost: float) -> Card:
    if math.isfinite(ratio):
        return "J / J*", number(ratio, 5), "cost beside the least possible; 1 is the best"
    known = math.isfinite(cost)
    return "cost J", number(cost, 5), "no optimum to compare it with" if known else _WHY


def _learned_card(analysis: BagAnalysis) -> Card:
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
    begun, ended = np.median(values[time <= time[0] + _EARLY]), np.median(values[late])
    change = f"{begun:.2g} → {ended:.2g}".replace("-", "\u2212")  # a hyphen would end a line
    return "learned", change, "Bellman error, at first and at the end"


def _halted(analysis: BagAnalysis) -> str:
    halted = sum(float(np.diff(spans, axis=1).sum()) for spans in analysis.charts.halts.values())
    return f"{halted:.3g} s waiting or stopped" if halted else "never stopped on the way"


def _millimetres(value: float) -> str:
    return _with_unit(1e3 * value, "mm")


def _with_unit(value: float, unit: str) -> str:
    return f"{number(value, 3)} {unit}" if math.isfinite(value) else NOT_MEASURED
