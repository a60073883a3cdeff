"""A recorded run on one time axis, with its place beside the path."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower.analysis.segments import segments_driven
from adp_path_follower.bags.columns import Series
from adp_path_follower.bags.reader import Diagnostic, Run
from adp_path_follower.core.errors import AdpError, FileError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.drive import project
from adp_path_follower.core.path.nearest import Projection
from adp_path_follower.core.path.route import Route, Segment
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.messages.configuration import parse_configuration
from adp_path_follower.study.replay.recorded_routes import RecordedRoutes

_OTHER_CLOCK = 1_000_000_000  # [ns] between arrival and stamp: they are of different clocks
_SAME_CLOCK_SHARE = 0.9  # of the commands that arrived exactly at the stamp of some odometry
_GREATEST = 1e8  # [m, m/s, rad/s]
_FLOOR = 1e-9  # [m/s, rad/s]: a command below it is zero


@dataclass(frozen=True)
class Timed:
    """Rows of numbers over time.

    Attributes:
        time: Since the robot was first told to move [s], shape (N,).
        values: Shape (N, M).
        labels: Names of the columns, where they have some.

    """

    time: FloatArray
    values: FloatArray
    labels: tuple[str, ...] = ()


class Clock:
    """Translates arrival into the clock of the stamps, where a bag was recorded by another."""

    def __init__(self, odometry: Series) -> None:
        """Find out by odometry, which has both times."""
        late = odometry.arrival - odometry.stamp
        self._other = bool(len(late)) and abs(float(np.median(late))) > _OTHER_CLOCK
        if self._other:
            self._origin, self._first = int(odometry.arrival[0]), int(odometry.stamp[0])
            # Relative, for a double cannot hold nanoseconds since 1970.
            self._arrival = (odometry.arrival - self._origin).astype(float)
            self._stamp = (odometry.stamp - self._first).astype(float)

    def stamps(self, arrival: np.ndarray) -> np.ndarray:
        """Return stamps [ns] for arrivals [ns]."""
        if not self._other:
            return arrival
        moved = np.interp((arrival - self._origin).astype(float), self._arrival, self._stamp)
        return np.asarray(self._first + moved.astype(np.int64))


@dataclass(frozen=True)
class Drive:
    """The data that the analysis of a bag uses.

    Attributes:
        run: Content of the bag.
        clock: Translates arrival into stamps.
        start: Stamp of the first odometry while the robot was told to move: time 0 [ns].
        end: Time at which it was last told to move [s].
        odometry: x, y, theta, v, w.
        projection: The odometry beside the path that was in force; in reverse, that of the robot
            turned round.
        segments: The segments of the paths, in order.
        segment_of_pose: Which of them was in force at each odometry, shape (N,).
        commands: v, w; no rows where no commands were recorded.
        latency: From the odometry that a command answers to the command, by arrival [s]; no rows
            where the recorder's clock does not tell.
        learner: The topics of the learner and its target that are in the bag.
        settings: The controller's, where the bag says them.
        notes: Sentences about data that could not be used.

    """

    run: Run
    clock: Clock
    start: int
    end: float
    odometry: Timed
    projection: Projection
    segments: tuple[Segment, ...]
    segment_of_pose: np.ndarray
    commands: Timed
    latency: FloatArray
    learner: dict[str, Timed]
    settings: Settings | None
    notes: tuple[str, ...]

    def seconds(self, arrival: int) -> float:
        """Return the time [s] of an arrival [ns]."""
        return float((self.clock.stamps(np.array([arrival]))[0] - self.start) * 1e-9)

    @property
    def driving(self) -> np.ndarray:
        """Return which of the odometry was recorded while the robot was told to move, (N,)."""
        return np.asarray((self.odometry.time >= 0.0) & (self.odometry.time <= self.end))


def drive_of(bag: FilePath, run: Run) -> Drive:
    """Return the drive that a run holds.

    Raises:
        FileError: There is no odometry or no path that can be followed.

    """
    notes = list(run.notes)
    odometry = _odometry(bag, run, notes)
    routes, route_times = _routes(bag, run, notes)
    clock = Clock(run.series["odom"])
    commands = _sorted(run.series.get("cmd_vel"), clock)
    moving = np.flatnonzero(np.abs(commands.values).max(axis=1, initial=0.0) > _FLOOR)
    # Without commands all of the odometry counts.
    first, last = odometry.stamp[0], odometry.stamp[-1]
    if len(moving):
        first, last = commands.stamp[moving[0]], commands.stamp[moving[-1]]
    index = max(0, int(np.searchsorted(odometry.stamp, first, side="right")) - 1)
    start = int(odometry.stamp[index])
    # A path that came after the first odometry is projected on from the first one.
    in_force = np.searchsorted(clock.stamps(route_times), odometry.stamp, side="right") - 1
    in_force = np.clip(in_force, 0, len(routes) - 1)
    poses = odometry.values[:, :3]
    segment_of_pose = _segments(routes, in_force, poses, odometry.values[:, 3])
    segments = tuple(itertools.chain.from_iterable(route.segments for route in routes))
    return Drive(
        run=run,
        clock=clock,
        start=start,
        end=float((last - start) * 1e-9),
        odometry=_timed(odometry, start),
        projection=_projection(segments, segment_of_pose, poses),
        segments=segments,
        segment_of_pose=segment_of_pose,
        commands=_timed(commands, start),
        latency=_latency(run.series["odom"], _between(commands, first, last), notes),
        learner=_learner(run, clock, start),
        settings=_settings(run, notes),
        notes=tuple(notes),
    )


def _odometry(bag: FilePath, run: Run, notes: list[str]) -> Series:
    """Return the odometry in order of its stamps, each once, without what is not finite."""
    found = run.series.get("odom")
    if found is None:
        raise FileError(
            f"bag {bag} has no odometry: name a topic of nav_msgs/msg/Odometry by --odom"
        )
    sound = _sound(found.values)
    if not sound.all():
        notes.append(f"{int((~sound).sum())} odometry messages are not finite: passed over")
    stamps, first = np.unique(found.stamp[sound], return_index=True)
    if not len(stamps):
        raise FileError(f"bag {bag} has no odometry that is finite: nothing to analyse")
    return Series(stamps, found.values[sound][first], (), found.arrival[sound][first])


def _sound(values: FloatArray) -> np.ndarray:
    """Return which rows are finite, and no greater than a robot's place or speed can be, (N,)."""
    return np.asarray((np.abs(values) < _GREATEST).all(axis=1))  # NaN is not below, either


def _routes(bag: FilePath, run: Run, notes: list[str]) -> tuple[list[Route], np.ndarray]:
    """Return the routes that can be followed, and when their paths arrived [ns]."""
    if not run.paths:
        raise FileError(f"bag {bag} has no path: name a topic of nav_msgs/msg/Path by --path")
    routes, times, problem = [], [], ""
    recorded = RecordedRoutes(run)
    for number, (time, poses) in enumerate(run.paths):
        if not len(poses):  # how planners take a path back
            continue
        try:
            routes.append(recorded.followed(number))
            times.append(time)
        except AdpError as error:
            problem = str(error)
            notes.append(f"a path was passed over: {problem}")
    if not routes:
        raise FileError(f"bag {bag} has no path that can be followed: {problem or 'it is empty'}")
    return routes, np.array(times, dtype=np.int64)


def _segments(
    routes: list[Route], in_force: np.ndarray, poses: FloatArray, speed: FloatArray
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
    segments: tuple[Segment, ...], segment_of_pose: np.ndarray, poses: FloatArray
) -> Projection:
    parts = []
    for number in np.unique(segment_of_pose).tolist():
        segment = segments[number]
        driven = poses[segment_of_pose == number]
        parts.append(project(segment.path, segment.heading_of_path(driven)))
    return Projection(
        np.concatenate([part.arc_length for part in parts]),
        np.concatenate([part.cross_track for part in parts]),
        np.concatenate([part.heading for part in parts]),
    )


def _sorted(series: Series | None, clock: Clock) -> Series:
    """Return commands in order of time, each stamp once; none where there is no series."""
    if series is None:
        return Series(np.zeros(0, dtype=np.int64), np.zeros((0, 2)))
    stamped = not np.array_equal(series.stamp, series.arrival)
    sound = _sound(series.values)
    stamp = series.stamp if stamped else clock.stamps(series.arrival)
    stamps, first = np.unique(stamp[sound], return_index=True)
    return Series(stamps, series.values[sound][first], (), series.arrival[sound][first])


def _timed(series: Series, start: int, stamp: np.ndarray | None = None) -> Timed:
    time = ((series.stamp if stamp is None else stamp) - start) * 1e-9
    return Timed(time, series.values, series.labels)


def _learner(run: Run, clock: Clock, start: int) -> dict[str, Timed]:
    """Return the learner's topics on the time axis.

    Weights and errors carry no stamp. With one message for each step they belong to the steps in
    order; else the time of their arrival, which lags, must do.
    """
    steps = run.series.get("tracking_error")
    found = {}
    for key, series in run.series.items():
        if key in ("odom", "cmd_vel"):
            continue
        stamp = series.stamp
        if np.array_equal(series.stamp, series.arrival):
            of_steps = steps is not None and len(steps.stamp) == len(stamp)
            stamp = steps.stamp if of_steps and steps else clock.stamps(series.arrival)
        found[key] = _timed(series, start, stamp)
    return found


def _between(series: Series, first: int, last: int) -> Series:
    """Return the messages from one stamp to another [ns]."""
    chosen = (series.stamp >= first) & (series.stamp <= last)
    return Series(series.stamp[chosen], series.values[chosen], (), series.arrival[chosen])


def _latency(odometry: Series, commands: Series, notes: list[str]) -> FloatArray:
    """Return how long after its odometry each command arrived [s].

    A command answers the odometry of its own stamp, which lock-step may have repeated; where there
    is none, the last that arrived before it.
    """
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

    Where all of it arrived after the command, which the recorder may see in the wrong order, it is
    the first.
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


def last_time(drive: Drive) -> float:
    """Return when the recording of odometry ended [s]."""
    return float(drive.odometry.time[-1]) if len(drive.odometry.time) else math.nan
