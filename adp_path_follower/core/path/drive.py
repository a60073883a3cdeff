"""The places on a path along a whole drive, by the least total error.

A path may cross itself, run lap upon lap, or lie in narrow lanes: one pose does not tell its place.
The drive has the sequence of places with the least sum of squared distances, in which
the place moves on about as far as the robot does. Dynamic programming over the places of least
distance finds it; between two anchors of the drive the nearest place near both is taken.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from adp_path_follower.core.geometry import FloatArray, tracking_error
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.nearest import Projection, beside, nearest_of

_STRIDE = 0.25  # [m] that the robot drives from one anchor to the next
_COARSE = 0.1  # [m] of the places that are compared, on a path that is long enough
_MOST_CANDIDATES = 256  # of an anchor
_MARGIN = 1.5  # [m] of distance beyond the least: candidates farther away are left out
_HEADING = 0.2  # [m²] that a heading error of 90 degrees costs
_SLACK, _STRETCH = 0.3, 1.6  # [m], and times the robot's way: how far a place may move on freely
_JUMP_COST = 20.0  # [m²] of a place that moves on without the robot
_BACKWARDS = 0.2  # [m] of cost a metre that a place moves back
_EARLY = 0.02  # [m²] for beginning at the end of the path instead of its start
_LEAST_JUMP = 1.0  # [m] between two poses, and ...
_MANY_STEPS = 5.0  # ... times a usual step: not driven, so the place may be anywhere
_SPACING = 0.02  # [m] of the places that are compared between anchors
_ON_PATH = 0.01  # [m] from the path: a target farther away is on another one
_LOST = 1e-4  # [m] between distance and cross-track: the place is not abreast of the robot
_MOST_CANDIDATES_BETWEEN = 2000  # two anchors
_CORNER_PLACES = 81  # about the nearest place, where Newton's method does not help
_PIECE = 20_000  # poses refined at once: all of a long drive would take hundreds of MB
_MOST_POSES = 1000  # between two anchors
_BLOCK = 2_000_000  # distances computed at once


@dataclass(frozen=True)
class _Anchors:
    """Poses of a drive that are assigned to the path as a whole."""

    index: np.ndarray  # number of each in the drive, shape (A,)
    way: FloatArray  # distance from the anchor before [m], shape (A,)
    carried: np.ndarray  # whether the robot was put elsewhere since the anchor before, shape (A,)


def project(
    path: Path,
    poses: FloatArray,
    driven: FloatArray | None = None,
    target: FloatArray | None = None,
) -> Projection:
    """Return the places of a path along a drive of poses [m, m, rad] in order of time, (N, 3).

    `driven` is the distance driven since the pose before [m], (N,), where it may be more than that
    between the two. `target` has poses on the path that the robot followed, (N, 3), NaN where
    unknown. Beyond the ends of an open path the distance is that to the end.
    """
    if not len(poses):
        return Projection(np.zeros(0), np.zeros(0), np.zeros(0))
    led = poses if target is None else _led(path, poses, target)
    anchors = _anchors(led, np.zeros(len(poses)) if driven is None else driven)
    places = _assigned(path, led, anchors)
    away = np.hypot(*(led - poses)[:, :2].T)
    arc_length = _between(path, poses, anchors, places, away)
    pieces = [slice(at, at + _PIECE) for at in range(0, len(poses), _PIECE)]
    parts = [vars(_exact(path, poses[rows], arc_length[rows])).values() for rows in pieces]
    return Projection(*map(np.concatenate, zip(*parts, strict=True)))


def _led(path: Path, poses: FloatArray, target: FloatArray) -> FloatArray:
    """Return the target where it is known and on the path, else the pose itself, (N, 3)."""
    known = np.flatnonzero(np.isfinite(target).all(axis=1))
    samples = path.samples
    tree = cKDTree(np.column_stack([samples.x, samples.y]))
    spacing = path.length / (len(samples.arc_length) - 1)
    known = known[tree.query(target[known, :2])[0] < _ON_PATH + spacing]
    led = poses.copy()
    led[known] = target[known]
    return led


def _exact(path: Path, poses: FloatArray, arc_length: FloatArray) -> Projection:
    """Return the exact places, and beyond an end the distance to the end."""
    found = _at_corners(path, poses, arc_length, beside(path, poses, arc_length, _SPACING))
    if path.closed:
        return found
    inside = np.clip(found.arc_length, 0.0, path.length)
    away = path.frame(inside).pose[:, :2] - poses[:, :2]
    beyond = inside != found.arc_length
    side = np.copysign(np.hypot(*away.T), found.cross_track)
    return Projection(inside, np.where(beyond, side, found.cross_track), found.heading)


def _at_corners(path: Path, poses: FloatArray, near: FloatArray, found: Projection) -> Projection:
    """Return places with those replaced that Newton's method does not find, as at a corner."""
    distance = np.hypot(*(path.frame(near).pose - poses)[:, :2].T)
    gap = np.hypot(*(path.frame(found.arc_length).pose - poses)[:, :2].T)
    lost = np.flatnonzero((gap > distance + 1e-9) | (gap - np.abs(found.cross_track) > _LOST))
    if not len(lost):
        return found
    around = np.linspace(-_SPACING, _SPACING, _CORNER_PLACES)
    best = nearest_of(path, poses[lost], near[lost, None] + around)
    pose = path.frame(best).pose
    error = tracking_error(poses[lost], pose)
    arc_length, cross_track, heading = (
        np.array(values) for values in (found.arc_length, found.cross_track, found.heading)
    )
    arc_length[lost], heading[lost] = best, error[:, 2]
    cross_track[lost] = np.copysign(np.hypot(error[:, 0], error[:, 1]), error[:, 1])
    return Projection(arc_length, cross_track, heading)


def _anchors(poses: FloatArray, driven: FloatArray) -> _Anchors:
    """Return anchors about every 0.25 m, and about every jump."""
    steps = np.hypot(*np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]).T)
    moving = steps[steps > 0.01 * _STRIDE]
    usual = float(np.median(moving)) if len(moving) else 0.0
    jumps = np.flatnonzero(steps > max(_LEAST_JUMP, _MANY_STEPS * usual))
    bins = np.floor(np.cumsum(steps) / _STRIDE)
    chosen = np.flatnonzero(np.diff(bins, prepend=-1.0))
    crowded = np.arange(0, len(poses), _MOST_POSES)
    index = np.unique(np.concatenate([chosen, crowded, jumps, np.maximum(jumps - 1, 0)]))
    chords = np.diff(poses[index, :2], axis=0, prepend=poses[index[:1], :2])
    carried = np.zeros(len(index), dtype=bool)
    carried[np.searchsorted(index, jumps)] = True
    since = np.diff(np.cumsum(driven)[index], prepend=0.0)
    return _Anchors(index, np.maximum(np.hypot(*chords.T), since), carried)


def _assigned(path: Path, poses: FloatArray, anchors: _Anchors) -> FloatArray:
    """Return the place of each anchor [m], shape (A,); it goes on over the laps."""
    candidates, own = zip(*_candidates(path, poses[anchors.index]), strict=True)
    total = own[0] + _EARLY * candidates[0] / path.length
    sources: list[np.ndarray] = []
    for number in range(1, len(own)):
        moved = candidates[number] - candidates[number - 1][:, None]
        if path.closed:
            moved = _shortest(moved, path.length)
        free = bool(anchors.carried[number])
        costs = total[:, None] + _moving_cost(moved, float(anchors.way[number]), free)
        source = np.argmin(costs, axis=0)
        sources.append(source)
        total = costs[source, np.arange(len(source))] + own[number]
    best = int(np.argmin(total))
    chain = [best]
    for source in reversed(sources):
        best = int(source[best])
        chain.append(best)
    chain.reverse()
    places = np.array([part[at] for part, at in zip(candidates, chain, strict=True)])
    if not path.closed:
        return places
    steps = np.diff(places)
    ahead = np.cumsum(_shortest(steps, path.length))
    return np.asarray(places[0] + np.concatenate([[0.0], ahead]))


def _candidates(path: Path, poses: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return for each of poses (A, 3) places of least distance [m] and their costs [m²], (K,)."""
    samples = path.samples
    last = len(samples.arc_length) - 1  # which is the first once more, if the path is closed
    thinned = np.arange(0, last, max(1, math.floor(_COARSE / (path.length / last))))
    if not path.closed:
        thinned = np.append(thinned, last)
    x, y = samples.x[thinned], samples.y[thinned]
    found = []
    rows = max(1, _BLOCK // len(thinned))
    for first in range(0, len(poses), rows):
        part = poses[first : first + rows]
        squared = (x - part[:, :1]) ** 2 + (y - part[:, 1:2]) ** 2
        beyond: dict[str, Any] = {"mode": "wrap"} if path.closed else {"constant_values": np.inf}
        padded = np.pad(squared, ((0, 0), (1, 1)), **beyond)
        least = (squared < padded[:, :-2]) & (squared <= padded[:, 2:])
        least[np.arange(len(part)), np.argmin(squared, axis=1)] = True
        for pose, row, chosen in zip(part, squared, least, strict=True):
            found.append(_near_enough(path, pose, row, thinned[chosen], np.flatnonzero(chosen)))
    return found


def _near_enough(
    path: Path, pose: FloatArray, squared: FloatArray, index: np.ndarray, column: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Return the candidates of one pose that are not much farther away than the nearest."""
    distance = np.sqrt(squared[column])
    order = np.argsort(distance, kind="stable")[:_MOST_CANDIDATES]
    order = np.sort(order[distance[order] <= distance.min() + _MARGIN])
    samples, index = path.samples, index[order]
    # At the foot of the perpendicular: coarse places differ by up to half their spacing.
    dx, dy = pose[0] - samples.x[index], pose[1] - samples.y[index]
    along = samples.cos[index] * dx + samples.sin[index] * dy
    spacing = _COARSE if path.length > _COARSE else path.length
    shift = np.clip(along, -spacing, spacing)
    rest = dx * dx + dy * dy - along * along + (along - shift) ** 2
    arc_length = samples.arc_length[index] + shift
    if not path.closed:
        arc_length = np.clip(arc_length, 0.0, path.length)
    agreement = samples.cos[index] * math.cos(pose[2]) + samples.sin[index] * math.sin(pose[2])
    return arc_length, np.maximum(rest, 0.0) + _HEADING * (1.0 - agreement)


def _shortest(moved: FloatArray, lap: float) -> FloatArray:
    """Return the moves [m], any shape, on a closed path the shorter way round."""
    return np.asarray(moved - lap * np.round(moved / lap))


def _moving_cost(moved: FloatArray, way: float, free: bool) -> FloatArray:
    """Return the cost of places that move [m], any shape, while the robot drives its way [m]."""
    if free:  # the nearest lap is as likely as any, and better for no other reason
        return np.asarray(0.001 * np.abs(moved))
    backwards = _BACKWARDS * np.maximum(-moved, 0.0)
    excess = np.maximum(np.abs(moved) - _SLACK - _STRETCH * way, 0.0)
    return np.asarray(np.minimum(backwards + _JUMP_COST * excess, _JUMP_COST))


def _between(
    path: Path, poses: FloatArray, anchors: _Anchors, places: FloatArray, away: FloatArray
) -> FloatArray:
    """Return the nearest place [m] to each pose (N,) about its anchors', `away` [m] from it."""
    arc_length = np.empty(len(poses))
    stops = np.append(anchors.index[1:], len(poses))
    ahead, ways = np.append(places[1:], places[-1]), np.append(anchors.way[1:], 0.0)
    for start, stop, here, there, way in zip(
        anchors.index, stops, places, ahead, ways, strict=True
    ):
        low, high = min(here, there), max(here, there)
        if high - low > _SLACK + _STRETCH * way:  # it jumps after these poses
            low = high = here
        reach = _SLACK + min(float(away[start:stop].max()), 0.5 * path.length)
        count = max(2, math.ceil((high - low + 2.0 * reach) / _SPACING) + 1)
        count = min(count, _MOST_CANDIDATES_BETWEEN)
        candidates = np.linspace(low - reach, high + reach, count)
        arc_length[start:stop] = nearest_of(path, poses[start:stop], candidates)
    return arc_length
