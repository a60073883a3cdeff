"""Fewer points for a figure that looks the same."""

import numpy as np

from adp_path_follower.core.geometry import FloatArray


def extremes(values: FloatArray, buckets: int) -> np.ndarray:
    """Return increasing indices of the values (N,) to keep so that a figure shows every peak.

    Each bucket of neighbouring values keeps its least and its greatest, and the first and the last
    of all are kept: at most 2 `buckets` + 2. Values that are not finite are no peaks.
    """
    count = len(values)
    if count <= 2 * buckets:
        return np.arange(count)
    width = -(-count // buckets)
    rows = -(-count // width)
    sound = np.isfinite(values)

    def places(fill: float, chosen: str) -> np.ndarray:
        padded = np.full(rows * width, fill)
        padded[:count] = np.where(sound, values, fill)
        within = getattr(padded.reshape(rows, width), chosen)(axis=1)
        return np.asarray(np.arange(rows) * width + within)

    kept = np.concatenate(
        [places(np.inf, "argmin"), places(-np.inf, "argmax"), np.array([0, count - 1])]
    )
    return np.unique(kept[kept < count])
