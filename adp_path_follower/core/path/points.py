"""The points of a path as given, before a curve is laid through them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.errors import PathError
from adp_path_follower.core.geometry import FloatArray

if TYPE_CHECKING:
    # Imported where paths are made: it takes as long as rclpy, and the controller's start does not
    # wait for it, as another process makes its paths.
    from scipy.interpolate import CubicSpline

MAX_POINTS = 1_000_000
_COINCIDENCE = 1e-6  # [m]: points nearer than this to the one before count once
_BLOCK = 8192  # rows at once, so that other threads get their turn
_CLOSING_GAP = 1e-3  # [m]: a path whose ends are nearer than this is closed


def chord_spline(points: FloatArray, closed: bool) -> tuple[CubicSpline, FloatArray]:
    """Return the C2 spline through points (N, 2), and their parameters: the chord lengths, (N,).

    The points of a closed path end with the first one.
    """
    from scipy.interpolate import CubicSpline

    chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
    parameter = np.concatenate([[0.0], np.cumsum(chords)])
    ends_condition = "periodic" if closed else "not-a-knot" if len(points) > 3 else "natural"
    return CubicSpline(parameter, points, bc_type=ends_condition), parameter


def joined(points: FloatArray, closed: bool | None) -> tuple[FloatArray, bool]:
    """Return points (N, 2) that end with the first one if the path is closed, and whether it is.

    Neighbours do not coincide. If `closed` is None, coinciding ends (1 mm) decide. Raises PathError
    for a closed path of fewer than three points.
    """
    apart = np.ptp(points, axis=0).max() > 2.0 * _CLOSING_GAP  # or all points are in one place
    meet = len(points) > 2 and math.dist(points[0], points[-1]) <= _CLOSING_GAP and bool(apart)
    if closed is None:
        closed = meet and len(points) > 3
    if closed:
        ends = points[:-1] if meet else points
        points = np.vstack([ends, ends[:1]])
        if len(points) < 4:
            raise PathError("a closed path needs at least 3 distinct points: add points")
    return points, closed


def averaged(points: FloatArray, width: float, most: float) -> FloatArray:
    """Return the means of points (N, 2) that lie within a width [m] along the way, and the ends.

    So rounded coordinates of dense points bend no curve. Returns the points as they are where most
    are farther apart, or where one would be more than `most` [m] beside the means.
    """
    chords = np.hypot(*np.diff(points, axis=0).T)
    place = np.concatenate([[0.0], np.cumsum(chords)])
    if np.median(chords) > 0.5 * width or place[-1] < 8.0 * width:
        return points
    first = np.flatnonzero(np.diff((place / width).astype(int), prepend=-1))
    counts = np.diff(first, append=len(points))
    rows = np.column_stack([place, points])
    means = np.add.reduceat(rows, first, axis=0) / counts[:, None]
    means[0], means[-1] = rows[0], rows[-1]
    beside = [np.interp(place, means[:, 0], means[:, axis]) for axis in (1, 2)] - points.T
    return np.ascontiguousarray(means[:, 1:]) if np.hypot(*beside).max() <= most else points


def distinct_points(points: ArrayLike) -> tuple[FloatArray, np.ndarray]:
    """Return points without coinciding neighbours (N, 2) and their indices (N,), or PathError."""
    try:
        array = np.asarray(points, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise PathError("path has points that are not pairs of numbers x, y") from None
    if array.ndim != 2 or array.shape[1] != 2:
        raise PathError(f"path has shape {array.shape}, but must be a list of x, y")
    if len(array) > MAX_POINTS:
        raise PathError(f"path has {len(array)} points, but at most {MAX_POINTS} are allowed")
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        first = int(np.argmax(bad))
        raise PathError(f"path point {first} is {array[first].tolist()}, but must be finite")
    if np.abs(array).max(initial=0.0) > 1e8:
        raise PathError("path has a coordinate above 1e8 m: check its units")
    kept = np.flatnonzero(_moving(array))
    if len(kept) < 2:
        raise PathError(f"path has {len(kept)} distinct points, but needs at least 2")
    return np.ascontiguousarray(array[kept]), kept


def _moving(points: FloatArray) -> np.ndarray:
    """Return which points are away from the last one that counts, shape (N,)."""
    moving = np.ones(len(points), dtype=bool)
    near = np.linalg.norm(np.diff(points, axis=0), axis=1) <= _COINCIDENCE
    last = 0
    for index in np.flatnonzero(near) + 1:
        if moving[index - 1]:
            last = int(index) - 1
        moving[index] = math.dist(points[index], points[last]) > _COINCIDENCE
    return moving


def in_blocks(function: Callable[[FloatArray], FloatArray], values: FloatArray) -> FloatArray:
    """Return a function of values (M,) in blocks: scipy's splines keep other threads waiting."""
    if len(values) <= _BLOCK:
        return function(values)
    starts = range(0, len(values), _BLOCK)
    return np.concatenate([function(values[start : start + _BLOCK]) for start in starts])
