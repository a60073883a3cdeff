"""Values with their uncertainty, from errors that hang together over short times."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from adp_path_follower.core.geometry import FloatArray


@dataclass(frozen=True)
class Estimate:
    """Values and standard deviations, shape (M,) each."""

    values: FloatArray
    deviations: FloatArray
    factor: float  # of the deviations, for an interval of 95 %

    def interval(self, index: int) -> tuple[float, float]:
        """Return the interval of 95 % of one value."""
        half = self.factor * float(self.deviations[index])
        value = float(self.values[index])
        return value - half, value + half


def estimate(
    values: FloatArray,
    errors: FloatArray,
    slopes: FloatArray,
    block: np.ndarray,
    unknown: FloatArray,
) -> Estimate:
    """Return fitted values (M,) with deviations.

    Errors (N,) are in standard deviations, slopes (N, M) their changes with the values. Errors of
    one block (N,) may hang together, those of two may not: the sum of the outer products of the
    blocks' gradients is the covariance of the whole gradient. It counts unless a fit of independent
    errors is less sure; `unknown` (M,) are the deviations before any drive.
    """
    information = slopes.T @ slopes + np.diag(unknown**-2.0)
    covariance = np.linalg.inv(information)
    _, rows = np.unique(block, return_inverse=True)
    count = int(rows.max()) + 1 if len(rows) else 0
    gradients = np.zeros((count, len(values)))
    np.add.at(gradients, rows, errors[:, None] * slopes)
    clustered = covariance @ (gradients.T @ gradients) @ covariance
    deviations = np.sqrt(np.maximum(np.diag(covariance), np.diag(clustered)))
    return Estimate(values, deviations, float(student.ppf(0.975, max(2, count - len(values)))))
