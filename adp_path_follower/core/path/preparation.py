"""Prepares a route from poses: smooths, cuts and orients it.

Where the spline through the points is fair, and stays within `path_tolerance` of their polyline,
it is the path. Otherwise the polyline is smoothed within the tolerance (`smoothing`). Where the
motion turns by more than 135 degrees within the tolerance (a cusp), and where the orientations say
that the robot changes between driving forwards and backwards, the route is cut. So it is at poses
in one place with different orientations: there the robot turns on the spot, as far as they do.
"""

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.errors import PathError
from adp_path_follower.core.geometry import FloatArray, contiguous, wrap_angle
from adp_path_follower.core.path.curve import Path, TurningBackError
from adp_path_follower.core.path.points import averaged, chord_spline, distinct_points, joined
from adp_path_follower.core.path.route import Route, Segment
from adp_path_follower.core.path.smoothing import Interpolation, bends, is_fair, smoothed
from adp_path_follower.core.path.unrounding import unrounded
from adp_path_follower.core.settings.groups import PathSettings

_DENSE = 0.25  # of the tolerance: poses that are nearer are averaged, ...
_MOVED = 0.02  # ... if that moves them by no more than this share of it
_ROUNDING = 0.25  # of the tolerance: the most that coordinates are rounded to, to be mended
_CUSP = math.cos(math.radians(135.0))  # of the turn from which on the motion is cut
_SHORT = 1.5  # times the tolerance: a chord that may hide the tip of a cusp
_DECIDED = 0.5  # cosine between orientation and motion from which on it says forwards, or backwards
_TURN = 0.2  # [rad] between poses in one place from which on the robot turns on the spot
_ALIGNED = 0.05  # [rad] between the last pose and the path's end that is no turn at the goal
_NO_WAY = 0.3  # [m]: a path that may be within xy_goal_tolerance, and not be driven
_SAID = {"auto": None, "open": False, "closed": True}


@dataclass(frozen=True)
class _Poses:
    """Distinct positions of a message."""

    points: FloatArray  # shape (N, 2) [m]
    headings: FloatArray  # shape (N,) [rad], NaN where a pose says none
    index: np.ndarray  # number of each in the message, (N,)

    def part(self, start: int, stop: int) -> "_Poses":
        """Return the poses from one number to another, both included."""
        rows = slice(start, stop + 1)
        return _Poses(self.points[rows], self.headings[rows], self.index[rows])

    def place(self, number: int) -> str:
        """Return number and place of a pose, for messages."""
        x, y = self.points[number]
        return f"pose {self.index[number]} at ({x:.2f}, {y:.2f})"


def prepare(
    points: ArrayLike,
    settings: PathSettings,
    headings: FloatArray | None = None,
    closed: bool | None = None,
) -> Route:
    """Return the route along poses: positions (N, 2) [m] and orientations (N,) [rad].

    An orientation is NaN where there is none; zero everywhere but at the ends counts as none, as
    some publishers leave them out. `closed` is what the source says, None leaves it to the
    settings. Raises PathError for points that make no path, or a route that is driven backwards
    without `allow_reversing`; the message names the place.
    """
    positions, index = distinct_points(points)
    count = len(np.asarray(points))
    given = np.full(count, np.nan) if headings is None else headings
    if given.shape != (count,):
        raise PathError(f"path has headings of shape {given.shape}, but must have {count} of them")
    given = np.where(np.isfinite(given), given, np.nan)
    useful = given if _is_oriented(given) else np.full(count, np.nan)
    poses = _Poses(positions, useful[index], index)
    said = _SAID[settings.path_closed] if closed is None else closed
    ends = np.append(index[1:], count) - 1  # the last pose in each place
    if said is None and ends[-1] > index[-1]:
        said = False  # its last pose comes twice
    turned = _turned(useful, index, ends)
    if turned.any():
        route = _turning_route(poses, useful[ends], turned, said, settings)
    else:
        route = _route(poses, said, settings)
    route = replace(route, bend_of_poses=float(np.abs(bends(positions, False)).max(initial=0.0)))
    return _with_goal(route, given, float(turned[-1]), settings)


def _turned(headings: FloatArray, index: np.ndarray, ends: np.ndarray) -> FloatArray:
    """Return by how much the poses from index to end in each place turn [rad], (N,), or zero."""
    known = np.maximum.accumulate(np.where(np.isfinite(headings), np.arange(len(headings)), 0))
    unwrapped = np.unwrap(np.nan_to_num(headings[known]))
    turned = unwrapped[ends] - unwrapped[index]
    return np.where(np.abs(turned) > _TURN, turned, 0.0)


def _turning_route(
    poses: _Poses, after: FloatArray, turned: FloatArray, said: bool | None, settings: PathSettings
) -> Route:
    """Return the route of poses that turn on the spot by angles (N,) to headings (N,)."""
    turns = np.flatnonzero(turned).tolist()
    if said:
        raise PathError(
            f"path is said to be closed, but turns on the spot at {poses.place(turns[0])}: a "
            "closed path cannot; leave path_closed at auto"
        )
    segments: list[Segment] = []
    for start, stop in itertools.pairwise(sorted({0, *turns, len(poses.points) - 1})):
        part = poses.part(start, stop)
        part = replace(part, headings=np.append(after[start], part.headings[1:]))
        first, *rest = _route(part, False, settings).segments
        segments += [replace(first, turn=float(turned[start])), *rest]
    return Route(tuple(segments))


def _with_goal(route: Route, headings: FloatArray, turned: float, settings: PathSettings) -> Route:
    """Return a route that ends with the last pose's heading, which turns by an angle [rad]."""
    wanted = float(headings[-1])
    asks = not math.isnan(wanted) and (_is_oriented(headings) or wanted)
    if route.closed or not settings.turn_at_goal or not asks:
        return route
    turn = float(wrap_angle(wanted - turned - _end_heading(route.segments[-1]))) + turned
    least = _ALIGNED if route.length > _NO_WAY else -1.0  # a path that is no way only turns
    return replace(route, goal_heading=wanted, goal_turn=turn) if abs(turn) > least else route


def _end_heading(segment: Segment) -> float:
    """Return the robot's heading at the end of a segment [rad]."""
    return float(segment.heading_of_path(segment.path.frame(segment.path.length).pose)[2])


def _route(poses: _Poses, said: bool | None, settings: PathSettings) -> Route:
    """Return the route of poses without turns on the spot."""
    if settings.path_tolerance == 0.0 and not settings.allow_reversing:
        return Route((Segment(Path.from_points(poses.points, said)),))
    unfit = None
    if not _against_motion(poses).any():
        unfit = _interpolation(poses.points, said, settings.path_tolerance)
        path = _exact(unfit, settings.path_tolerance)
        if path is not None:
            return Route((Segment(path),))
    return _cut_route(poses, said, settings, unfit)


def _is_oriented(headings: FloatArray) -> bool:
    """Return whether headings (N,) are more than zeros, or those of both ends."""
    inner = headings[1:-1] if len(headings) > 2 else headings[:1]
    return bool(np.nan_to_num(inner).any())


def _against_motion(poses: _Poses) -> np.ndarray:
    """Return for each chord whether the orientations at its ends point backwards, (N - 1,)."""
    chords = np.diff(poses.points, axis=0)
    motion = np.arctan2(*contiguous(chords.T[::-1]))
    ends = [np.cos(poses.headings[:-1] - motion), np.cos(poses.headings[1:] - motion)]
    return np.asarray((ends[0] < -_DECIDED) & (ends[1] < -_DECIDED))


def _interpolation(points: FloatArray, said: bool | None, tolerance: float) -> Interpolation:
    points, closed = joined(points, said)
    points, moved = unrounded(points, closed, _ROUNDING * tolerance)
    points = averaged(points, _DENSE * tolerance, _MOVED * tolerance)
    return Interpolation(*chord_spline(points, closed), points, closed, moved)


def _exact(through: Interpolation, tolerance: float) -> Path | None:
    """Return the path through the points if it is smooth and near their polyline, else None."""
    if tolerance > 0.0 and not is_fair(through, tolerance):
        return None
    try:
        return Path.along(through.spline, through.parameter, through.closed)
    except TurningBackError:
        return None


def _cut_route(
    poses: _Poses, said: bool | None, settings: PathSettings, unfit: Interpolation | None
) -> Route:
    """Return the route of poses that need smoothing, cuts or driving backwards.

    `said` is what the source says about closing, `unfit` the spline through all of them, if it is
    known not to be the path. Raises PathError if it needs `allow_reversing`, or cannot be smoothed.
    """
    tolerance = settings.path_tolerance
    _, closed = joined(poses.points, said)
    kept = _thinned(poses.points, tolerance)
    cusps = _cusps(poses.points[kept], tolerance)
    directions = _directions(poses, kept, cusps)
    changes = np.flatnonzero(np.diff(directions) != 0) + 1
    if closed and said is None and len(kept) > 3:
        around = np.diff(poses.points[kept], axis=0)[[-1, 0]]
        closed = bool(_cosines(around)[0] > _CUSP)  # else it comes back to its beginning, and ends
    cuts = sorted(set(cusps.tolist()) | set(changes.tolist()))
    tips = [_tip(poses.points, kept, cut) for cut in cuts]
    if not settings.allow_reversing:
        _refuse_reversing(poses, tips, set(cusps.tolist()) & set(cuts), cuts, directions)
    if not cuts:
        path = _fitted(poses, closed if said is None else said, tolerance, unfit)
        return Route((Segment(path, bool(directions[0] < 0)),))
    if said:
        raise PathError(
            f"path is said to be closed, but turns back at {poses.place(tips[0])}: a closed path "
            "cannot; leave path_closed at auto"
        )
    bounds = [0, *tips, len(poses.points) - 1]
    segments: list[Segment] = []
    for number, (start, stop) in enumerate(itertools.pairwise(bounds)):
        if stop <= start:
            continue
        reverse = bool(directions[0 if number == 0 else cuts[number - 1]] < 0)
        segment = Segment(_fitted(poses.part(start, stop), False, tolerance), reverse)
        if segments and segments[-1].reverse is reverse:
            begin = segment.heading_of_path(segment.path.frame(0.0).pose)[2]
            turn = float(wrap_angle(begin - _end_heading(segments[-1])))
            segment = replace(segment, turn=turn)
        segments.append(segment)
    return Route(tuple(segments))


def _thinned(points: FloatArray, distance: float) -> np.ndarray:
    """Return the numbers of points a distance [m] away from the one before, and of the last."""
    chords = np.hypot(*np.diff(points, axis=0).T)
    if chords.min() >= distance:
        return np.arange(len(points))
    kept = [0]
    x, y = points[0].tolist()
    squared = distance * distance
    for number, (next_x, next_y) in enumerate(points.tolist()):
        if (next_x - x) ** 2 + (next_y - y) ** 2 >= squared:
            kept.append(number)
            x, y = next_x, next_y
    last = len(points) - 1
    if kept[-1] != last:
        # The rest is too short to say where it leads, unless it is all there is.
        kept = [*(kept[:-1] if len(kept) > 1 else kept), last]
    return np.array(kept)


def _cosines(chords: FloatArray, apart: int = 1) -> FloatArray:
    """Return the cosine of the turn between each chord and the one so many on, (K - apart,)."""
    lengths = np.maximum(np.hypot(*chords.T), 1e-12)
    products = (chords[:-apart] * chords[apart:]).sum(axis=1)
    return np.asarray(products / (lengths[:-apart] * lengths[apart:]))


def _cusps(points: FloatArray, tolerance: float) -> np.ndarray:
    """Return at which of points (K, 2) the motion turns back, also about a thinned tip."""
    chords = np.diff(points, axis=0)
    at_once = np.append(_cosines(chords) < _CUSP, False)
    in_two = np.zeros(len(at_once), dtype=bool)
    if len(chords) > 2:
        short = np.hypot(*chords[1:-1].T) < _SHORT * tolerance
        in_two[:-2] = short & (_cosines(chords, 2) < _CUSP)
    for number in np.flatnonzero(in_two).tolist():
        if not at_once[max(number - 1, 0) : number + 2].any():
            at_once[number] = True
    return np.flatnonzero(at_once) + 1


def _directions(poses: _Poses, kept: np.ndarray, cusps: np.ndarray) -> np.ndarray:
    """Return 1 or, backwards, -1 for each chord: by orientations, else as before the last cusp."""
    chords = np.diff(poses.points[kept], axis=0)
    motion = np.arctan2(*contiguous(chords.T[::-1]))
    # Sums over all poses from one kept point to the next, both included.
    known = np.isfinite(poses.headings)
    parts = np.where(known, [np.cos(poses.headings), np.sin(poses.headings), known], 0.0)
    sums = np.concatenate([np.zeros((3, 1)), np.cumsum(parts, axis=1)], axis=1)
    *both, count = sums[:, kept[1:] + 1] - sums[:, kept[:-1]]
    cos, sin = np.array(both) / np.maximum(count, 1.0)
    agreement = cos * np.cos(motion) + sin * np.sin(motion)
    decided = np.where(np.abs(agreement) > _DECIDED, np.sign(agreement), 0.0)
    flips = np.ones(len(chords))
    flips[cusps] = -1.0
    steady = np.cumprod(flips)  # the direction if no orientation said anything
    says = np.flatnonzero(decided)
    if not len(says):
        return steady
    # Each chord goes by the last one before it that says something, the first ones by the next.
    source = says[np.maximum(np.searchsorted(says, np.arange(len(chords)), side="right") - 1, 0)]
    return np.asarray(decided[source] * steady[source] * steady)


def _tip(points: FloatArray, kept: np.ndarray, cut: int) -> int:
    """Return the number of the point where the motion turns back, near a kept one."""
    beyond = kept[min(cut + 2, len(kept) - 1)]
    before, here, after = points[kept[cut - 1]], points[kept[cut]], points[beyond]
    outward = (here - before) / math.dist(here, before) - (after - here) / math.dist(after, here)
    if math.hypot(*outward) < 1.0:  # it does not: the orientations have changed
        return int(kept[cut])
    near = points[kept[cut - 1] + 1 : beyond]
    return int(kept[cut - 1]) + 1 + int(np.argmax((near - here) @ outward))


def _refuse_reversing(
    poses: _Poses, tips: list[int], cusps: set[int], cuts: list[int], directions: np.ndarray
) -> None:
    """Raise where the robot would have to turn back, or to drive backwards."""
    for cut, tip in zip(cuts, tips, strict=True):
        if cut in cusps:
            raise PathError(
                f"path turns back at {poses.place(tip)}: cut it there into two paths, or set "
                "allow_reversing"
            )
    if (directions < 0).any():
        first = 0 if directions[0] < 0 else tips[int(np.argmax(directions[np.array(cuts)] < 0))]
        raise PathError(
            f"path is to be driven backwards from {poses.place(first)} on, by the orientations of "
            "its poses: turn them along the path, or set allow_reversing"
        )


def _fitted(
    poses: _Poses, closed: bool, tolerance: float, unfit: Interpolation | None = None
) -> Path:
    """Return the path of a segment, other than the `unfit` one; PathError if smoothing fails."""
    if unfit is not None and unfit.closed != closed:
        unfit = None
    through = unfit or _interpolation(poses.points, closed, tolerance)
    try:
        path = None if unfit else _exact(through, tolerance)
        if path is not None:
            return path
        if tolerance == 0.0:
            return Path.along(through.spline, through.parameter, through.closed)
        curve, step = smoothed(through, tolerance - through.moved)
        curve, _ = distinct_points(curve)
        if through.closed:  # also where only one of its last points counts
            curve[-1] = curve[0]
        return Path.along(*chord_spline(curve, through.closed), through.closed, step)
    except TurningBackError as error:
        nearest = int(np.argmin(np.hypot(*(poses.points - np.array(error.place)).T)))
        raise PathError(
            f"path cannot be smoothed within path_tolerance ({tolerance:g} m) at "
            f"{poses.place(nearest)}: raise path_tolerance, or make the path smoother there"
        ) from None
