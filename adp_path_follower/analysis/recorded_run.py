"""A recorded run on one time axis, with its place beside the path."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower.analysis.followed import followed_routes, segments_driven
from adp_path_follower.analysis.motion import Motion, motion_of
from adp_path_follower.analysis.stamps import Clock, Timeline, timed_stamps, timeline
from adp_path_follower.bags.columns import Series
from adp_path_follower.bags.reader import Diagnostic, Run
from adp_path_follower.core.errors import AdpError, FileError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.drive import project
from adp_path_follower.core.path.nearest import Projection
from adp_path_follower.core.path.route import Route, Segment
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.messages.configuration import parse_configuration

_SAME_CLOCK_SHARE = 0.9  # of the commands that arrived exactly at the stamp of some odometry
_FLOOR = 1e-9  # [m/s, rad/s]: a command below it is zero
_NO_COMMANDS = Series(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
_RECENT = 0.5  # [s]: an older target is not the robot's any more
_NEAR = 1.0  # [m]: who never was so near to the path was to follow another one


@dataclass(frozen=True)
class Timed:
    """Rows of numbers in order of time."""

    time: FloatArray  # since the robot was first told to move [s], shape (N,)
    values: FloatArray  # shape (N, M)
    labels: tuple[str, ...] = ()  # names of the columns, where they have some


@dataclass(frozen=True)
class Drive:
    """The data that the analysis of a bag uses."""

    run: Run  # content of the bag
    clock: Clock  # translates arrival into stamps
    # "odom" and "cmd_vel" -> their messages, with times that can be trusted.
    timelines: dict[str, Timeline]
    frames: tuple[str, str]  # frames of the paths and of the odometry
    motion: Motion  # the steps from each odometry to the next
    start: int  # stamp of the first odometry while the robot was told to move: time 0 [ns]
    end: float  # time at which it was last told to move [s]
    odometry: Timed  # x, y, theta in the frame of the path, where that is known, v, w
    # The odometry beside the path that was in force, NaN where its place in the frame of the path
    # is not known; in reverse, that of the robot turned round.
    projection: Projection
    segments: tuple[Segment, ...]  # the segments of the paths, in order
    segment_of_pose: np.ndarray  # which of them was in force at each odometry, shape (N,)
    commands: Timed  # v, w; no rows where no commands were recorded
    # From the odometry that a command answers to the command, by arrival [s]; no rows where the
    # recorder's clock does not tell.
    latency: FloatArray
    learner: dict[str, Timed]  # the topics of the learner and its target that are in the bag
    settings: Settings | None  # the controller's, where the bag says them
    notes: tuple[str, ...]  # sentences about data that could not be used

    def seconds(self, arrival: int) -> float:
        """Return the time [s] of an arrival [ns]."""
        return float((self.clock.stamps(np.array([arrival]))[0] - self.start) * 1e-9)

    @property
    def states(self) -> list[tuple[str, float, float]]:
        """Return each state of the controller, from when and until when [s]; empty if unknown."""
        changes = controller_states(self.run.diagnostics)
        times = [self.seconds(change.time) for change in changes]
        ends = [*times[1:], max(float(self.odometry.time[-1]), *times[-1:])] if times else []
        states = (change.state for change in changes)
        return list(zip(states, times, ends, strict=True))

    @property
    def driving(self) -> np.ndarray:
        """Return which of the odometry was recorded while the robot was told to move, (N,)."""
        return np.asarray((self.odometry.time >= 0.0) & (self.odometry.time <= self.end))

    @property
    def compared(self) -> np.ndarray:
        """Return which of the odometry has a place beside the path, shape (N,)."""
        return np.isfinite(self.projection.cross_track)

    @property
    def in_one_frame(self) -> np.ndarray:
        """Return which of the odometry can be drawn together: beside the path, else all, (N,)."""
        return self.compared | (not self.compared.any())


def drive_of(bag: FilePath, run: Run, path: FloatArray | None = None) -> Drive:
    """Return the drive of a run, on its own path or on poses x, y, heading (N, 3).

    Raises FileError if there is no odometry or no path that can be followed.
    """
    line = _odometry(bag, run)
    odometry = line.series
    clock = Clock(line)
    followed = followed_routes(bag, run, line, clock, path)
    told = timeline(run.series.get("cmd_vel", _NO_COMMANDS), run.topics.get("cmd_vel", ""), clock)
    commands = told.series
    moving = np.flatnonzero(np.abs(commands.values).max(axis=1, initial=0.0) > _FLOOR)
    # Without commands all of the odometry counts.
    first, last = odometry.stamp[0], odometry.stamp[-1]
    if len(moving):
        first, last = commands.stamp[moving[0]], commands.stamp[moving[-1]]
    index = max(0, int(np.searchsorted(odometry.stamp, first, side="right")) - 1)
    start = int(odometry.stamp[index])
    speed = odometry.values[:, 3]
    time = (odometry.stamp - start) * 1e-9
    motion = motion_of(time, odometry.values[:, :3], speed, line.cut)
    known = np.isfinite(followed.poses[:, 0])
    in_force = np.where(known, followed.in_force, -1)
    in_frame = np.c_[followed.poses, odometry.values[:, 3:]]
    segment_of_pose = _segments(followed.routes, in_force, followed.poses, speed)
    segments = tuple(itertools.chain.from_iterable(route.segments for route in followed.routes))
    learner = _learner(run, clock, start)
    target = _target_at(time, learner.get("target"))
    projection = _projection(segments, segment_of_pose, followed.poses, motion, target)
    notes = [*run.notes, *line.notes, *followed.notes, *told.notes, *_far_off(projection)]
    notes += motion.doubts()
    return Drive(
        run=run,
        clock=clock,
        timelines={"odom": line, "cmd_vel": told},
        frames=followed.frames,
        motion=motion,
        start=start,
        end=float((last - start) * 1e-9),
        odometry=Timed(time, np.where(known[:, None], in_frame, odometry.values)),
        projection=projection,
        segments=segments,
        segment_of_pose=segment_of_pose,
        commands=Timed((commands.stamp - start) * 1e-9, commands.values),
        latency=_latency(line, _between(commands, first, last), notes),
        learner=learner,
        settings=_settings(run, notes),
        notes=tuple(dict.fromkeys(notes)),
    )


def _odometry(bag: FilePath, run: Run) -> Timeline:
    """Return the odometry in order of its times, each once, without what is not finite."""
    found = run.series.get("odom")
    if found is None:
        raise FileError(
            f"bag {bag} has no odometry: name a topic of nav_msgs/msg/Odometry by --odom"
            f"{run.causes}"
        )
    line = timeline(found, run.topics.get("odom", "odometry"))
    if not len(line.series.stamp):
        raise FileError(f"bag {bag} has no odometry that is finite: nothing to analyse")
    return line


def _segments(
    routes: Sequence[Route], in_force: np.ndarray, poses: FloatArray, speed: FloatArray
) -> np.ndarray:
    """Return which of all segments is driven at each pose, shape (N,)."""
    found = np.zeros(len(poses), dtype=np.intp)
    first = 0
    for number, route in enumerate(routes):
        chosen = in_force == number
        found[chosen] = first + segments_driven(route, poses[chosen], speed[chosen])
        first += len(route.segments)
    return found


def _projection(
    segments: tuple[Segment, ...],
    segment_of_pose: np.ndarray,
    poses: FloatArray,
    motion: Motion,
    target: FloatArray,
) -> Projection:
    """Return the places beside the segments, NaN where poses (N, 3) are."""
    columns = np.full((3, len(poses)), np.nan)
    for number in np.unique(segment_of_pose).tolist():
        segment, rows = segments[number], np.isfinite(poses[:, 0]) & (segment_of_pose == number)
        found = project(
            segment.path,
            segment.heading_of_path(poses[rows]),
            motion.reach[rows],
            segment.heading_of_path(target[rows]),
        )
        columns[:, rows] = found.arc_length, found.cross_track, found.heading
    return Projection(*columns)


def _far_off(projection: Projection) -> list[str]:
    """Return a sentence if the robot was never near the path."""
    away = np.abs(projection.cross_track[np.isfinite(projection.cross_track)])
    if not len(away) or away.min() < _NEAR:
        return []
    return [
        f"the robot was never nearer than {away.min():.1f} m to the path: is it the one that it "
        "was to follow, and in its frame?"
    ]


def _target_at(time: FloatArray, target: Timed | None) -> FloatArray:
    """Return the virtual target's pose at times [s], NaN where none is recorded, shape (N, 3)."""
    found = np.full((len(time), 3), np.nan)
    if target is None or not len(target.time):
        return found
    last = np.searchsorted(target.time, time + 1e-9, side="right") - 1
    known = (last >= 0) & (time - target.time[np.maximum(last, 0)] < _RECENT)
    found[known] = target.values[last[known], :3]
    return found


def _learner(run: Run, clock: Clock, start: int) -> dict[str, Timed]:
    """Return the learner's topics in order, by step if each has a message, else by arrival."""
    steps = run.series.get("tracking_error")
    found = {}
    for key, series in run.series.items():
        if key in ("odom", "cmd_vel"):
            continue
        stamp = timed_stamps(series, clock)
        if np.array_equal(series.stamp, series.arrival):
            of_steps = steps is not None and len(steps.stamp) == len(stamp)
            stamp = timed_stamps(steps, clock) if of_steps and steps else stamp
        sorted_already = bool((np.diff(stamp) >= 0).all())  # else a copy, of an hour 200 MB
        order = slice(None) if sorted_already else np.argsort(stamp, kind="stable")
        found[key] = Timed((stamp[order] - start) * 1e-9, series.values[order], series.labels)
    return found


def _between(series: Series, first: int, last: int) -> Series:
    """Return the messages from one stamp to another [ns]."""
    chosen = (series.stamp >= first) & (series.stamp <= last)
    return Series(series.stamp[chosen], series.values[chosen], (), series.arrival[chosen])


def _latency(line: Timeline, commands: Series, notes: list[str]) -> FloatArray:
    """Return how long [s] each command came after the odometry of its stamp, or the last before."""
    odometry = Series(line.all_stamps, np.zeros((0, 0)), (), line.all_arrivals)
    if not len(commands.stamp):
        return np.zeros(0)
    if np.isin(commands.arrival, odometry.stamp).mean() > _SAME_CLOCK_SHARE:
        notes.append(
            "no latency: the recorder's clock went on only with the odometry, as simulated time "
            "does in lock-step"
        )
        return np.zeros(0)
    own, arrival = _last_before(odometry, commands)
    arrivals = np.sort(odometry.arrival)
    before = np.searchsorted(arrivals, commands.arrival, side="right") - 1
    source = np.where(own, arrival, arrivals[np.maximum(before, 0)])
    late = (commands.arrival - source) * 1e-9
    return np.asarray(late[own | (before >= 0)])


def _last_before(odometry: Series, commands: Series) -> tuple[np.ndarray, np.ndarray]:
    """Return which commands have the stamp of odometry, and the arrival of the last such [ns].

    Where the recorder saw all of it after the command, it is the first.
    """
    order = np.lexsort((odometry.arrival, odometry.stamp))
    stamps, arrivals = odometry.stamp[order], odometry.arrival[order]
    begin = np.searchsorted(stamps, commands.stamp, side="left")
    end = np.searchsorted(stamps, commands.stamp, side="right")
    found = arrivals[np.minimum(begin, len(arrivals) - 1)]
    for index in np.flatnonzero(end > begin + 1).tolist():
        same = arrivals[begin[index] : end[index]]
        place = int(np.searchsorted(same, commands.arrival[index], side="right")) - 1
        found[index] = same[max(place, 0)]
    return end > begin, found


def _settings(run: Run, notes: list[str]) -> Settings | None:
    """Return the settings that the run began with, None where the bag does not say."""
    if not run.configurations:
        return None
    try:
        return parse_configuration(run.configurations[0][1]).settings
    except AdpError as error:
        notes.append(f"the configuration was passed over: {error}")
        return None


def controller_states(diagnostics: tuple[Diagnostic, ...]) -> tuple[Diagnostic, ...]:
    """Return the state changes of the controller, of the first that said its state."""
    stating = [item for item in diagnostics if item.state]
    changes: list[Diagnostic] = []
    for item in stating:
        if item.name == stating[0].name and (not changes or changes[-1].state != item.state):
            changes.append(item)
    return tuple(changes)


def period_of(drive: Drive) -> FloatArray:
    """Return the time between commands while the robot was told to move [s]."""
    time = drive.commands.time
    return np.diff(time[(time >= 0.0) & (time <= drive.end)])


def finite(values: FloatArray) -> FloatArray:
    """Return the values that are finite."""
    return np.asarray(values[np.isfinite(values)])
