"""When a run has settled, is past its transient, or is off the path: one definition of each."""

import numpy as np

from adp_path_follower.core.geometry import FloatArray

SETTLED = 0.05  # norm of e = [s, y, theta] [m, m, rad]
TRANSIENT = 10.0  # [s]
TRANSIENT_SHARE = 1.0 / 3.0  # of a shorter run
OFF_PATH = 0.5  # [m]
APPROACHED_SHARE = 0.05  # of the distance from the path at the start
APPROACHED_LEAST = 0.01  # [m]


def is_settled(error: FloatArray) -> np.ndarray:
    """Return where |e| of finite e = [s, y, theta] (..., 3) is below 0.05, shape (...)."""
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", error, error)) < SETTLED)


def is_off_path(distance: FloatArray) -> np.ndarray:
    """Return where a distance from the path [m] is above 0.5 m or not finite, same shape."""
    return ~(np.abs(distance) <= OFF_PATH)


def transient(duration: float) -> float:
    """Return the transient [s] of a run's duration [s]: 10 s, or a third of a short run."""
    return min(TRANSIENT, TRANSIENT_SHARE * duration)


def has_approached(distance: FloatArray) -> np.ndarray:
    """Return where distances over time [m] (N,) are below 5 % of the first one, or 10 mm, (N,)."""
    first = float(np.abs(distance[0])) if len(distance) else 0.0
    return np.asarray(np.abs(distance) < max(APPROACHED_SHARE * first, APPROACHED_LEAST))


def time_to_stay(time: FloatArray, inside: np.ndarray) -> float:
    """Return the time from the start [s] after which a run stays inside, infinite if it does not.

    The samples have times [s] (N,), N at least 1, and whether the run is inside then, shape (N,).
    """
    outside = np.flatnonzero(~inside)
    first = int(outside[-1]) + 1 if len(outside) else 0
    return float(time[first] - time[0]) if first < len(time) else float("inf")
