"""Where along the path a recorded robot was, from its poses alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray, tracking_error
from adp_path_follower.core.path.curve import Path

_REACH = 0.5  # [m] of path that is searched beyond how far the robot drove
_STRIDE = 0.5  # [m] that the robot drives while one stretch of path is searched
_MOST_POSES = 1000  # searched at once
_SPACING = 0.02  # [m] of the candidates
_JUMP = 1.0  # [m] between two poses: not driven, so the whole path is searched again
_NEWTON_STEPS = 4
_PIECE = 20_000  # poses
_LEAST_SLOPE = 0.1  # of Newton's method, which has none at the centre of the path's curvature


@dataclass(frozen=True)
class Projection:
    """Poses beside a path; one row for each pose.

    Attributes:
        arc_length: Of the place abreast of the robot [m]; goes on over the laps of a closed path.
        cross_track: Distance from the path [m], positive to its left.
        heading: Heading less that of the path [rad], in [-pi, pi).

    """

    arc_length: FloatArray
    cross_track: FloatArray
    heading: FloatArray


def project(path: Path, poses: FloatArray) -> Projection:
    """Return the places of a path nearest to the poses of a drive, each near the one before.

    A path may cross itself, and the nearest place of the whole would then jump from one branch to
    the other. Only at the start, and where the robot was put elsewhere, is the whole path
    searched; there the heading tells branches apart.

    Args:
        path: The path.
        poses: x [m], y [m], theta [rad] in order of time, shape (N, 3).

    """
    arc_length = np.zeros(len(poses))
    steps = np.linalg.norm(np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2]), axis=1)
    driven = np.cumsum(steps)
    jumps = np.flatnonzero(steps > _JUMP)
    start, place = 0, 0.0
    while start < len(poses):
        if start == 0 or steps[start] > _JUMP:
            place = path.nearest(poses[start])
        stop = int(np.searchsorted(driven, driven[start] + _STRIDE, side="right"))
        next_jump = jumps[np.searchsorted(jumps, start, side="right") :][:1]
        stop = min(max(stop, start + 1), start + _MOST_POSES, *next_jump.tolist(), len(poses))
        reach = _REACH + min(_JUMP, steps[start]) + driven[stop - 1] - driven[start]
        arc_length[start:stop] = _nearest(path, poses[start:stop, :2], place, reach)
        place, start = float(arc_length[stop - 1]), stop
    pieces = range(0, len(poses), _PIECE)  # all at once would take hundreds of MB
    found = [_refined(path, poses[at : at + _PIECE], arc_length[at : at + _PIECE]) for at in pieces]
    columns = [np.concatenate(parts) for parts in zip(*found, strict=True)] or [np.zeros(0)] * 3
    return Projection(*columns)


def _refined(
    path: Path, poses: FloatArray, arc_length: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the exact places abreast of poses, and distance and heading there, shape (N,) each."""
    for _ in range(_NEWTON_STEPS):  # until the tangential error is 0
        frame = path.frame(arc_length)
        error = tracking_error(poses, frame.pose)
        slope = np.maximum(1.0 - frame.curvature * error[:, 1], _LEAST_SLOPE)
        arc_length = arc_length + np.clip(error[:, 0] / slope, -_SPACING, _SPACING)
    # Beyond the ends of an open path its tangents go on, so `y` is the distance from those.
    error = tracking_error(poses, path.frame(arc_length).pose)
    return arc_length, error[:, 1], error[:, 2]


def _nearest(path: Path, positions: FloatArray, place: float, reach: float) -> FloatArray:
    """Return the nearest candidates [m] around a place, shape (N,)."""
    candidates = place + np.linspace(-reach, reach, 2 * math.ceil(reach / _SPACING) + 1)
    points = path.frame(candidates).pose[:, :2]
    squared = ((positions[:, None] - points) ** 2).sum(axis=2)
    return np.asarray(candidates[np.argmin(squared, axis=1)])
