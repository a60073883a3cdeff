"""Take the bends out of a path that its rounded coordinates make.

A millimetre of rounding bends a path of points 0.1 m apart by 0.1 1/m. Where the numbers show to
what they are rounded, the smoothest path is taken that rounds to them (Whittaker's smoothing).
"""

import math

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.points import averaged

_SIZES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)  # [m] to which coordinates may be rounded
_FEWEST = 8  # points; fewer tell nothing
_SPREAD, _MOST = 0.28, 0.8  # of the rounding: RMS of a coordinate (1/sqrt 12), and the most
_WEIGHTS = 10.0 ** np.arange(13)  # of the third differences
_ROUNDS = 7  # of solving, with ten times the weight where points are too far away
_STEPS = 8.0  # times the rounding: over such a width the steps of dense points are averaged, ...
_CUT = 0.9  # ... if that moves them by no more, in roundings
_ALIKE, _NEAR = 4.0, 17  # times what is usual among so many points: no corner, but a curve
_APART = 0.1  # roundings between neighbours, at least: distinct ones are a whole rounding apart
_PINNED = 1e6  # weight of the ends
_AROUND = 300  # points of a closed path beyond its ends


def unrounded(points: FloatArray, closed: bool, most: float) -> tuple[FloatArray, float]:
    """Return points (N, 2) without the bends that rounded coordinates make, if they are rounded.

    Corners, and bends that rounding cannot explain, stay; so do the ends, and points that are
    rounded to more than `most` [m]. Those of a closed path end with the first one. Returns also by
    how much they were moved [m].
    """
    size = next((size for size in _SIZES if _are_multiples(points, size)), math.inf)
    if size > most or len(points) < _FEWEST:
        return points, 0.0
    means = averaged(points, _STEPS * size, _CUT * size)
    if _nearest(means) < _APART * size:  # as at the tip of a cusp
        return points, 0.0
    moved = _CUT * size if len(means) < len(points) else 0.0
    if closed:
        around = min(_AROUND, len(means) - 1)
        rows = np.pad(means[:-1], ((around, around), (0, 0)), mode="wrap")
        found = _smoothest(rows, size)[around:-around]
        found = np.vstack([found, found[:1]])
    else:
        found = _smoothest(means, size)
    if not _nearest(found) >= _APART * size:
        return points, 0.0
    return found, moved + float(np.hypot(*(found - means).T).max())


def _nearest(points: FloatArray) -> float:
    """Return the least distance of points (N, 2) from the next one [m]."""
    return float(np.hypot(*np.diff(points, axis=0).T).min())


def _are_multiples(points: FloatArray, size: float) -> bool:
    """Return whether all coordinates are rounded to multiples of a size [m]."""
    count = points / size
    return bool((np.abs(count - np.rint(count)) <= 1e-3 + 1e-15 * np.abs(count)).all())


def _smoothest(points: FloatArray, size: float) -> FloatArray:
    """Return the points (N, 2) of least third differences that differ as rounded ones do [m]."""
    from scipy.linalg import solveh_banded
    from scipy.ndimage import maximum_filter1d

    banded, wanted = _equations(points, size)
    own = np.ones(len(points))
    own[[0, -1]] = _PINNED
    found = points
    for weight in _WEIGHTS:
        for _ in range(_ROUNDS):
            matrix = weight * banded
            matrix[-1] += own
            away = solveh_banded(matrix, weight * wanted)
            far = np.abs(away).max(axis=1) > _MOST * size
            if not far.any():
                break
            own = np.where(maximum_filter1d(far, _ROUNDS), 10.0 * own, own)
        free = away[own == 1.0]
        if far.any() or not len(free) or (free**2).mean(axis=0).max() > (_SPREAD * size) ** 2:
            break
        found = points - away
    return np.ascontiguousarray(found)


def _equations(points: FloatArray, size: float) -> tuple[FloatArray, FloatArray]:
    """Return D'D, in the form of solveh_banded (4, N), and D'D times points (N, 2).

    D are the third differences, but for those at corners: they change more than rounding explains,
    and more than the others around them.
    """
    from scipy.ndimage import median_filter

    count = len(points) - 3
    factors = _third_differences(points)
    bends = np.stack([factors[:, k, None] * points[k : count + k] for k in range(4)]).sum(axis=0)
    steps = np.abs(np.diff(bends, axis=0, prepend=bends[:1], append=bends[-1:])).max(axis=1)
    change = np.maximum(steps[:-1], steps[1:])
    explained = 8.0 * size + _ALIKE * median_filter(change, _NEAR)
    factors = factors * (change <= explained)[:, None]
    banded, wanted = np.zeros((4, len(points))), np.zeros_like(points)
    for first in range(4):
        wanted[first : count + first] += factors[:, first, None] * bends
        for second in range(first, 4):
            place = slice(second, count + second)
            banded[3 - second + first, place] += factors[:, first] * factors[:, second]
    return banded, wanted


def _third_differences(points: FloatArray) -> FloatArray:
    """Return what four neighbours of points (N, 2) count in their third difference, (N - 3, 4).

    At even distances -1, 3, -3 and 1; else in the proportions of the divided differences.
    """
    place = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    at = np.stack([place[k : len(place) - 3 + k] for k in range(4)])
    apart = at[:, None] - at[None]
    apart[np.arange(4), np.arange(4)] = 1.0
    factors = 1.0 / (apart / (at[3] - at[0])).prod(axis=1).T
    return np.asarray(factors * (8.0 / np.abs(factors).sum(axis=1, keepdims=True)))
