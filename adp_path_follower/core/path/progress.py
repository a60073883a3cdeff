"""Where following begins on a route, and where it goes on.

A pose alone does not tell laps, lanes and the two ends of a loop apart. A new route begins at the
earliest place among those that the pose cannot tell apart. After a stop, and on a route that is
the former one with other ends, following goes on where it was.
"""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.route import Route
from adp_path_follower.core.settings.groups import ControllerSettings

NOISE = 0.1  # [m] of distance that tells no two places apart, and ...
_SHARE = 0.1  # ... of the distance from the path: far away, more places look alike
_FITS = math.radians(60.0)  # heading error of a place that the robot may be about to drive on from
_TURN = math.radians(30.0)  # difference of heading errors that tells no two places apart
CARRIED = 1.0  # [m] that a robot may move while it does not follow, by coasting or noise
_REACH = 0.5  # [m] of path about the last place that is searched, beside how far the robot moved
_SAME = 0.1  # [m] between two routes that are the same but for their ends
_SLIP = 0.02  # of the distance from the last place, by which they may differ more
_COMPARED = 20.0  # [m] of them to either side of the last place
_DRIFT = 1.0  # [m] between two routes of the same lengths: one path, in frames that drift apart
_FARTHER = 0.1  # of distance that a place is worth which is a metre nearer to the last one
_NEIGHBOURS = 5  # samples to either side


@dataclass(frozen=True)
class Place:
    """A place of a route."""

    segment: int = 0  # number of the segment
    arc_length: float = 0.0  # s_p on it [m]

    def along(self, route: Route) -> float:
        """Return the arc length along the whole route [m], on a closed one within a lap."""
        if route.closed:
            return self.arc_length % route.length
        before = sum(segment.path.length for segment in route.segments[: self.segment])
        return before + self.arc_length


@dataclass(frozen=True)
class Left:
    """Where following ended."""

    route: Route  # the route that was followed
    place: Place  # where the virtual target was
    pose: FloatArray  # where the robot was, shape (3,)
    done: bool  # whether that was the end of the route


@dataclass(frozen=True)
class _Candidate:
    """A place of least distance in its neighbourhood."""

    place: Place  # the place
    distance: float  # from the robot [m]
    turn: float  # heading error there, without sign [rad]


def new_start(route: Route, pose: FloatArray, controller: ControllerSettings) -> Place:
    """Return where a new route begins for a pose (3,); SettingsError if that is past its end."""
    if controller.path_start == "beginning":
        return Place()
    if controller.path_start == "nearest":
        return Place(*route.nearest(pose))
    if controller.path_start == "arc_length":
        return _place_at(route, controller.start_arc_length)
    return first_place(route, pose)


def _place_at(route: Route, arc_length: float) -> Place:
    """Return the place at an arc length [m] along a whole route."""
    if arc_length > route.length:
        raise SettingsError(
            f"setting 'start_arc_length' is {arc_length:g}, but the path is {route.length:.2f} m "
            "long: lower it"
        )
    rest = arc_length
    for number, segment in enumerate(route.segments[:-1]):
        if rest < segment.path.length:
            return Place(number, rest)
        rest -= segment.path.length
    return Place(len(route.segments) - 1, rest)


def first_place(route: Route, pose: FloatArray) -> Place:
    """Return the earliest place of a route among those that a pose (3,) cannot tell apart.

    Candidates are the places with the least distance in their neighbourhood. A later one is taken
    only where it is clearly nearer, or where the heading speaks against the earlier ones; on an
    open route not even then, if the robot is at the first pose.
    """
    found = _candidates(route, pose)
    least = min(candidate.distance for candidate in found)
    alike = [item for item in found if item.distance <= least + NOISE + _SHARE * least]
    beginning = route.segments[0].path.frame(0.0).pose
    if not route.closed and math.dist(beginning[:2], pose[:2]) <= NOISE:
        return alike[0].place
    turn = min(item.turn for item in alike)
    if turn <= _FITS:
        alike = [item for item in alike if item.turn <= turn + _TURN]
    return alike[0].place


def next_place(route: Route, pose: FloatArray, left: Left) -> Place | None:
    """Return where following goes on after it ended, None if the route is another one.

    That is near the last place (`left`). A robot that was carried away is searched for on the whole
    route by its pose (3,), unless it is on the path ahead or behind as far as it moved.
    """
    last = _carried_over(left, route)
    if last is None:
        return None
    moved = math.dist(pose[:2], left.pose[:2])
    near, distance = _near(route, pose, last, _REACH + moved)
    if moved <= CARRIED:
        return near
    least = min(candidate.distance for candidate in _candidates(route, pose))
    return near if distance <= least + NOISE + _SHARE * least else first_place(route, pose)


def _near(route: Route, pose: FloatArray, last: Place, reach: float) -> tuple[Place, float]:
    """Return the nearest place within a reach [m] of the last one, and its distance [m]."""
    path = route.segments[last.segment].path
    samples = path.samples
    pieces = len(samples.arc_length) - 1
    step = path.length / pieces
    reach = min(reach, path.length)  # all of it, however far the robot was carried
    first, last_one = (round((last.arc_length + end) / step) for end in (-reach, reach))
    around = np.arange(first, last_one + 1)
    around = around if path.closed else np.unique(np.clip(around, 0, pieces))
    lap, index = np.divmod(around, pieces) if path.closed else (np.zeros(len(around)), around)
    arc_length = samples.arc_length[index] + path.length * lap
    distance = np.hypot(samples.x[index] - pose[0], samples.y[index] - pose[1])
    best = int(np.argmin(np.hypot(distance, _FARTHER * (arc_length - last.arc_length))))
    first = max(0, best - _NEIGHBOURS)  # the nearest of its surroundings, as `first_place` has it
    best = first + int(np.argmin(distance[first : best + _NEIGHBOURS + 1]))
    return Place(last.segment, float(arc_length[best])), float(distance[best])


def _carried_over(left: Left, new: Route) -> Place | None:
    """Return the last place on a route that is the same but for its ends, else None.

    They are the same if they are so about the last place. Where one can lie over the
    other in several ways, as with laps, the longest common stretch counts, and that only one end is
    another. After the end of the old route only one that goes on from there is the same.
    """
    old, last = left.route, left.place
    if old is new or old.digest() == new.digest():
        return last
    if _only_moved(old, new) and not left.done:
        return last
    if old.closed or new.closed:
        return None
    target = old.segments[last.segment]
    pose = target.path.frame(last.arc_length).pose
    found = []
    for item in _candidates(new, target.heading_of_path(pose)):
        segment = new.segments[item.place.segment]
        if item.distance > _SAME or item.turn > _FITS or segment.reverse is not target.reverse:
            continue
        shift = item.place.arc_length - last.arc_length
        shared = _shared(target.path, segment.path, last.arc_length, shift, _SAME)
        goes_on = item.place.along(new) < new.length - _SAME
        if shared > 0.0 and (goes_on or not left.done):
            grown = segment.path.length - target.path.length - shift
            found.append((0.5 * min(abs(shift), abs(grown)) - shared, abs(shift), item.place))
    return min(found, key=lambda item: item[:2])[2] if found else None


def _only_moved(old: Route, new: Route) -> bool:
    """Return whether two routes are one that was transformed by frames that drift apart."""
    if len(old.segments) != len(new.segments) or old.closed is not new.closed:
        return False
    return all(
        math.isclose(before.path.length, after.path.length, rel_tol=1e-6)
        and before.reverse is after.reverse
        and _shared(before.path, after.path, 0.0, 0.0, _DRIFT) > 0.0
        for before, after in zip(old.segments, new.segments, strict=True)
    )


def _candidates(route: Route, pose: FloatArray) -> list[_Candidate]:
    """Return the places of least distance to a pose (3,) in their neighbourhoods, in order."""
    found = []
    for number, segment in enumerate(route.segments):
        samples = segment.path.samples
        distance = np.hypot(samples.x - pose[0], samples.y - pose[1])
        heading = segment.heading_of_path(pose)[2]
        cos = samples.cos * math.cos(heading) + samples.sin * math.sin(heading)
        for index in _minima(distance, segment.path.closed):
            place = Place(number, float(samples.arc_length[index]))
            turn = math.acos(min(max(float(cos[index]), -1.0), 1.0))
            found.append(_Candidate(place, float(distance[index]), turn))
    return found


def _minima(distance: FloatArray, closed: bool) -> list[int]:
    """Return where distances (M,) along a path are least in their neighbourhood, in order."""
    before, after = (distance[-2], distance[1]) if closed else (np.inf, np.inf)
    padded = np.concatenate([[before], distance, [after]])
    least = (padded[1:-1] < padded[:-2]) & (padded[1:-1] <= padded[2:])
    if closed:
        least[-1] = False  # the start once more
    return np.flatnonzero(least).tolist() or [int(np.argmin(distance))]


def _shared(old: Path, new: Path, last: float, shift: float, tolerance: float) -> float:
    """Return the length [m] that two paths share if s_new = s_old + shift, 0 if they differ.

    They are compared within 20 m of the last place on the old one. The same poses, cut elsewhere,
    are smoothed a little differently, so arc lengths drift apart with the distance from there.
    """
    start, stop = max(0.0, shift), min(new.length, old.length + shift)
    first, end = max(start, last + shift - _COMPARED), min(stop, last + shift + _COMPARED)
    if end <= first:
        return 0.0
    place = np.linspace(first, end, math.ceil((end - first) / _SAME) + 2)
    away = new.frame(place).pose[:, :2] - old.frame(place - shift).pose[:, :2]
    allowed = tolerance + _SLIP * np.abs(place - shift - last)
    return stop - start if (np.hypot(*away.T) <= allowed).all() else 0.0
