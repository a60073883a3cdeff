"""The routes and segments that a recorded robot was to follow, and its poses in their frame."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
from scipy.spatial import cKDTree

from adp_path_follower.analysis.stamps import Clock, Timeline
from adp_path_follower.bags.columns import Series
from adp_path_follower.bags.reader import Run
from adp_path_follower.bags.transforms import frame_name, read_transforms
from adp_path_follower.core.errors import AdpError, FileError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path, TurningBackError
from adp_path_follower.core.path.points import chord_spline, distinct_points, joined
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.path.route import Route, route_of
from adp_path_follower.core.path.smoothing import Interpolation
from adp_path_follower.core.settings.groups import PathSettings
from adp_path_follower.study.replay.recorded_driver import RecordedRoutes

_STOOD = 500_000_000  # [ns] for which a robot has stood that waits for a path, ...
_STILL, _DROVE = 0.01, 0.1  # [m] ... moving less than this, and more before
_SPACING = 0.02  # [m] of the places that poses are compared with
_AS_DRAWN = 0.002  # [m] from the polyline that a path may be, and where there are ...
_MANY, _OF_MANY = 20, 0.01  # ... more paths than this, as of a planner that plans all the time


def segments_driven(route: Route, poses: FloatArray, speed: FloatArray) -> np.ndarray:
    """Return the number of the segment that each pose [x, y, theta] (N, 3) belongs to, shape (N,).

    Poses are in order of time, with a speed v [m/s] (N,), negative backwards. The numbers never
    fall; of all such numbers these have the least squared distances, summed up over the way driven.
    The direction of motion counts as the heading does in `best_place`.
    """
    if len(route.segments) == 1 or not len(poses):
        return np.zeros(len(poses), dtype=np.intp)
    features = _features(poses + np.pi * (speed < 0.0)[:, None] * [0.0, 0.0, 1.0])
    squared = [_tree(segment.path).query(features)[0] ** 2 for segment in route.segments]
    driven = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
    return _monotone(driven[:, None] * np.column_stack(squared))


def _tree(path: Path) -> cKDTree:
    count = max(2, math.ceil(path.length / _SPACING) + 1)
    return cKDTree(_features(path.frame(np.linspace(0.0, path.length, count)).pose))


def _features(poses: FloatArray) -> FloatArray:
    """Return x, y, cos and sin of the heading, so weighted that distances are `best_place`'s."""
    share = math.sqrt(0.5)
    heading = poses[:, 2]
    return np.column_stack([poses[:, :2], share * np.cos(heading), share * np.sin(heading)])


def _monotone(costs: FloatArray) -> np.ndarray:
    """Return columns (N,) of costs (N, K), never falling, of least sum, by dynamic programming."""
    rows, columns = costs.shape
    total = np.vstack([np.zeros(columns), np.cumsum(costs, axis=0)])  # of the rows before each
    # Least cost of the rows before each with the columns up to k, and with at least one in k.
    best = np.full((rows + 1, columns + 1), np.inf)
    best[0] = 0.0
    own = np.full((rows + 1, columns), np.inf)
    for column in range(columns):
        changes = best[:-1, column] - total[:-1, column]  # to this column, by the row it begins at
        own[1:, column] = total[1:, column] + np.minimum.accumulate(changes)
        best[1:, column + 1] = np.minimum(best[1:, column], own[1:, column])
    found = np.empty(rows, dtype=np.intp)
    stop = rows
    for column in reversed(range(columns)):
        if stop and own[stop, column] < best[stop, column]:
            begin = int(np.argmin(best[:stop, column] - total[:stop, column]))
            found[begin:stop] = column
            stop = begin
    return found


@dataclass(frozen=True)
class Followed:
    """The routes of a run."""

    routes: tuple[Route, ...]  # in the order in which they were in force
    in_force: np.ndarray  # which of them was in force at each odometry, shape (N,)
    # The odometry's x, y, theta in the frame of its route, NaN where that is not known, (N, 3).
    poses: FloatArray
    frames: tuple[str, str]  # frames of the paths and of the odometry, as sentences have them
    notes: tuple[str, ...]  # sentences about what was left out or brought to another frame


def followed_routes(
    bag: FilePath, run: Run, odometry: Timeline, clock: Clock, path: FloatArray | None
) -> Followed:
    """Return the routes of a run; a path that came after the first odometry counts from there on.

    `clock` translates arrival to the odometry's clock. `path` has poses x, y, heading to compare
    with; None takes the bag's. Raises FileError if no path can be followed.
    """
    notes: list[str] = []
    found: Sequence[tuple[int, Route, str]]
    if path is not None:
        found = [(0, route_along(path), "")]
    else:
        found = RecordedRoutes(run).in_force() or _recorded(bag, run, notes)
    times = np.array([time for time, _, _ in found], dtype=np.int64)
    in_force = np.searchsorted(clock.stamps(times), odometry.series.stamp, side="right") - 1
    in_force = np.clip(in_force, 0, len(found) - 1)
    own = run.series["odom"].frame
    poses = odometry.series.values[:, :3].copy()
    moved: dict[str, FloatArray] = {}
    frames = list(dict.fromkeys(frame for _, _, frame in found if frame)) or [own]
    for number, (_, _, frame) in enumerate(found):
        rows = in_force == number
        if not frame or not own or frame_name(frame) == frame_name(own) or not rows.any():
            continue
        if frame not in moved:
            moved[frame] = _moved(bag, odometry, own, frame, notes)
        poses[rows] = moved[frame][rows]
    earlier = _earlier_drive(odometry.series, int(clock.stamps(times)[0]))
    if earlier:
        poses[:earlier] = np.nan
        notes.append(f"{earlier} poses of a drive before the path came are not compared with it")
    return Followed(
        tuple(route for _, route, _ in found), in_force, poses, (", ".join(frames), own),
        tuple(notes),
    )  # fmt: skip


def _earlier_drive(odometry: Series, came: int) -> int:
    """Return how many poses are from before a path came [ns] to a robot that had driven, and stood.

    Zero if it was moving, for then it was following the path, which was recorded late.
    """
    before, still = np.searchsorted(odometry.stamp, [came, came - _STOOD])
    places = odometry.values[:before, :2]
    if still < 1 or before < 2 or np.ptp(places[still - 1 :], axis=0).max() > _STILL:
        return 0
    return int(before) if np.ptp(places, axis=0).max() > _DROVE else 0


def _recorded(bag: FilePath, run: Run, notes: list[str]) -> list[tuple[int, Route, str]]:
    """Return arrival, route and frame of each path in the bag that can be followed."""
    if not run.paths:
        raise FileError(
            f"bag {bag} has no path: name a topic of nav_msgs/msg/Path by --path, or a file"
            f"{run.causes}"
        )
    found: list[tuple[int, Route, str]] = []
    problem = ""
    frames = run.path_frames or ("",) * len(run.paths)
    recorded = RecordedRoutes(run)
    tolerance = _OF_MANY if len(run.paths) > _MANY else _AS_DRAWN
    whole = np.zeros((0, 3))
    for number, ((time, poses), frame) in enumerate(zip(run.paths, frames, strict=True)):
        if not len(poses):  # how planners take a path back
            continue
        rest = whole[max(0, len(whole) - len(poses)) :]
        if found and frame == found[-1][2] and np.array_equal(poses, rest, equal_nan=True):
            continue  # what the robot has left behind is cut off: it began there all the same
        try:
            route = recorded.followed(number)
            found.append((time, route or route_along(poses, tolerance), frame))
            whole = poses
        except AdpError as error:
            problem = str(error)
            notes.append(f"a path was passed over: {problem}")
    if not found:
        raise FileError(f"bag {bag} has no path that can be followed: {problem or 'it is empty'}")
    return found


def route_along(poses: FloatArray, tolerance: float = _AS_DRAWN) -> Route:
    """Return the route along poses x, y, heading (NaN without), shape (N, 3).

    Another controller rounds the polyline as it likes, so the route may be as far from the poses as
    the tolerance [m]. Raises PathError if they make no path.
    """
    try:
        points, index = distinct_points(poses[:, :2])
        points, closed = joined(points, None)
        motion = np.arctan2(*np.diff(points, axis=0).T[::-1])
        heading = poses[index, 2][: len(motion)]
        forwards = not (np.cos(heading - motion[: len(heading)]) < 0.0).any()
        through = Interpolation(*chord_spline(points, closed), points, closed)
        if forwards and through.bulges.max() <= tolerance:
            return route_of(Path.from_points(points, closed))
    except TurningBackError:
        pass
    settings = PathSettings(path_tolerance=tolerance, allow_reversing=True)
    return prepare(poses[:, :2], settings, poses[:, 2])


def _moved(bag: FilePath, odometry: Timeline, own: str, frame: str, notes: list[str]) -> FloatArray:
    """Return the poses of the odometry in the frame of a path, NaN where unknown, (N, 3)."""
    series = odometry.series
    times = series.arrival if odometry.by_arrival or odometry.cut.any() else series.stamp
    moved = read_transforms(bag).moved(
        series.values[:, :3], frame_name(own), frame_name(frame), times, times is not series.stamp
    )
    share = 0.0 if moved is None else float(np.isfinite(moved[:, 0]).mean())
    if moved is None or not share:
        notes.append(
            f"nothing is compared with the path in frame '{frame}': the odometry is in '{own}', "
            f"and the bag has no transform between them{'' if moved is None else ' at that time'}; "
            f"record /tf and /tf_static, too, or name a path in '{own}' by --path"
        )
        return np.full((len(times), 3), np.nan)
    partly = "" if share == 1.0 else f", which is known for {100.0 * share:.1f} % of it"
    notes.append(f"the odometry was brought from frame '{own}' to '{frame}' by /tf{partly}")
    return moved
