"""Which segment of a route a recorded robot was driving, from its poses alone."""

import math

import numpy as np
from scipy.spatial import cKDTree

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.route import Route

_SPACING = 0.02  # [m] of the places that poses are compared with


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
