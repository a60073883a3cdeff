"""Values with their uncertainty, from errors that hang together over short times."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from adp_path_follower.core.geometry import FloatArray


@dataclass(frozen=True)
class Estimate:
    """Values and half-widths of their intervals of 95 %, shape (M,) each."""

    values: FloatArray
    room: FloatArray


def estimate(
    values: FloatArray,
    errors: FloatArray,
    slopes: FloatArray,
    block: np.ndarray,
    unknown: FloatArray,
) -> Estimate:
    """Return better values (M,), by one step of least squares, with intervals.

    Errors (N,) are those of the values, slopes (N, M) their changes. Errors of one block (N,) may
    hang together, those of two may not: the sum of the outer products of the blocks' gradients is
    the covariance of the whole gradient. It counts unless a fit of independent errors is less sure;
    `unknown` (M,) are the deviations before any drive.
    """
    for _ in range(2):  # the second time with the size of the errors that remain
        size = max(float(np.sqrt(np.mean(errors**2))), 1e-4)
        covariance = np.linalg.inv(slopes.T @ slopes / size**2 + np.diag(unknown**-2.0))
        step = covariance @ slopes.T @ errors / size**2
        values, errors = values - step, errors - slopes @ step
    errors, slopes = errors / size, slopes / size
    _, rows = np.unique(block, return_inverse=True)
    gradients = np.zeros((rows.max() + 1, len(values)))
    np.add.at(gradients, rows, errors[:, None] * slopes)
    clustered = covariance @ (gradients.T @ gradients) @ covariance
    factor = student.ppf(0.975, max(2, len(gradients) - len(values)))
    room = factor * np.sqrt(np.maximum(np.diag(covariance), np.diag(clustered)))
    return Estimate(values, room)
