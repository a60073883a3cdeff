"""The analysis of one bag, small enough to keep beside those of others."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import numpy as np

from adp_path_follower.analysis.costs import costs_of
from adp_path_follower.analysis.events import events_of
from adp_path_follower.analysis.metrics import (
    METRICS,
    Requirement,
    measure_drive,
    time_in_state,
    with_states,
)
from adp_path_follower.analysis.recorded_run import Drive, drive_of
from adp_path_follower.analysis.run_charts import charts_of
from adp_path_follower.analysis.trust import Trust, trust_of
from adp_path_follower.bags.reader import read_run
from adp_path_follower.core.path.library import is_path_file, named_points
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import flatten, yaml_text
from adp_path_follower.drawing.charts import ShownRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SPACING = 0.05  # [m] of the points of a path without any
NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class BagAnalysis(ShownRun):
    """The analysis of one bag: its `name`, `events`, the data of its figures `charts`, and more.

    Attributes:
        metrics: Name -> value, NaN where the bag does not tell.
        states: State of the controller -> time in it [s].
        events_left_out: The events that were left out, as a sentence, empty if nothing is.
        settings: Name -> value as text; empty where the bag does not say.
        topics: Topic -> number of messages.
        used: The role of a topic -> the topic.
        notes: Sentences about data that could not be used.
        trust: Causes and limits of the numbers.

    """

    metrics: Mapping[str, float]
    states: Mapping[str, float]
    events_left_out: str
    settings: Mapping[str, str]
    topics: Mapping[str, int]
    used: Mapping[str, str]
    notes: tuple[str, ...]
    trust: Trust

    def __repr__(self) -> str:
        """Return the chief numbers in one line."""
        metrics = self.metrics
        return (
            f"BagAnalysis({self.name}: {metrics['duration']:.1f} s, {metrics['distance']:.1f} m, "
            f"cross-track RMS {1e3 * metrics['cross_track_rms']:.2f} mm, J {metrics['cost']:.6g}, "
            f"{len(self.events)} events)"
        )

    def plot(self, axes: "Axes | None" = None) -> "Axes":
        """Plot where the robot drove, on given axes or new ones; return them."""
        from adp_path_follower.drawing.run_figures import draw_track, plotted

        return plotted(lambda place: draw_track(place, self.charts.track), axes)

    @property
    def numbers(self) -> dict[str, float]:
        """Return all numbers that a requirement can name."""
        return with_states(self.metrics, self.states)

    def meets(self, requirement: Requirement) -> bool:
        """Return whether the bag keeps a limit, and measured what it is about."""
        return requirement.met(self.numbers) and not self.trust.doubt(requirement.name)


def number(value: float, digits: int = 5) -> str:
    """Return a number as people read it, words for one that is not known."""
    if not math.isfinite(value):
        return NOT_MEASURED
    whole = value == round(value) or abs(value) >= 10.0**digits
    return f"{value:.0f}" if whole and abs(value) < 1e9 else f"{value:.{digits}g}"


def metrics_table(analyses: Sequence[BagAnalysis]) -> str:
    """Return the metrics of bags side by side, as a text for the terminal."""
    width = max(12, *(len(item.name) for item in analyses))
    lines = [f"{'':26}" + "".join(f"{item.name:>{width + 2}}" for item in analyses)]
    for metric in METRICS:
        texts = [number(item.metrics[metric.name], 6) for item in analyses]
        cells = "".join(f"{text:>{width + 2}}" for text in texts)
        lines.append(f"{metric.name:26}{cells}  {metric.unit}".rstrip())
    for item in analyses:
        lines += ["", f"{item.name}:", *(f"  {sentence}" for sentence in item.trust.sentences())]
    return "\n".join(lines)


def names_of(bags: Sequence[FilePath]) -> list[str]:
    """Return each bag's name, with the folders that tell it apart, or a number if given twice."""
    parts = [bag.resolve().parts for bag in bags]
    found = []
    for number, own in enumerate(parts):
        others = [other for other in parts if other != own]
        shown = next(
            (
                count
                for count in range(1, len(own))
                if all(other[-count:] != own[-count:] for other in others)
            ),
            len(own),
        )
        again = parts[:number].count(own)
        found.append(str(FilePath(*own[-shown:])) + (f" ({again + 1})" if again else ""))
    return found


def analyse_bag(
    bag: FilePath,
    names: Mapping[str, str],
    bags: int,
    trajectory: FilePath | None,
    progress: Callable[[float], None] | None = None,
    title: str | None = None,
    shared: Settings | None = None,
) -> BagAnalysis:
    """Return the analysis of a bag, a rosbag2 directory or one of its files.

    `names` maps "odom", "cmd_vel" or "path" to the topic to take for it, "path" also to a file;
    `bags` share the figures. J is counted by `shared` settings, else by those that the bag names.
    The trajectory is written for the tool evo, unless its file is None. `progress` takes the
    fraction done; the title is by default the name of directory or file. Raises FileError if the
    bag cannot be read, or holds no odometry or path.
    """
    path, names = None, dict(names)
    if is_path_file(names.get("path", "")):
        path = named_points(names["path"], _SPACING)
        names["path"] = ""  # none of the bag's
    drive = drive_of(bag, read_run(bag, names, progress), path)
    costs, of_costs, optimum = costs_of(drive, shared or drive.settings)
    metrics = measure_drive(drive, costs)
    if trajectory is not None:
        _write_tum(drive, trajectory)
    events, left_out = events_of(drive)
    settings = {} if drive.settings is None else flatten(drive.settings)
    return BagAnalysis(
        name=bag.name or str(bag) if title is None else title,
        metrics=metrics,
        states=time_in_state(drive),
        charts=charts_of(drive, bags, optimum),
        events=events,
        events_left_out=left_out,
        settings={name: yaml_text(value) for name, value in settings.items()},
        topics=drive.run.message_counts,
        used=drive.run.topics,
        notes=(*drive.notes, *of_costs, *filter(None, [left_out])),
        trust=trust_of(drive, metrics),
    )


def _write_tum(drive: Drive, file: FilePath) -> None:
    """Write stamp [s], position and quaternion while driving, one pose a line (TUM format)."""
    driving = drive.driving & drive.in_one_frame
    stamps = drive.start + np.rint(drive.odometry.time[driving] * 1e9).astype(np.int64)
    poses = drive.odometry.values[driving, :3]
    half = 0.5 * poses[:, 2]
    # A stamp since 1970 with its nanoseconds does not fit into a double.
    rows = zip(
        stamps.tolist(), *poses[:, :2].T.tolist(), np.sin(half).tolist(), np.cos(half).tolist(),
        strict=True,
    )  # fmt: skip
    with file.open("w", encoding="ascii") as stream:
        for stamp, x, y, sine, cosine in rows:
            second, rest = divmod(stamp, 1_000_000_000)
            stream.write(f"{second}.{rest:09d} {x:.9f} {y:.9f} 0 0 0 {sine:.9f} {cosine:.9f}\n")
