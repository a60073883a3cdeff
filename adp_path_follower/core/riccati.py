"""The Riccati solution along a path: a safe policy for every curvature, known before learning.

Linearised about the path, the error dynamics are e' = A(kappa) e + B u with

    A = [[-k1, kappa v_des, 0], [-kappa v_des, 0, v_des], [-k1 kappa, 0, 0]],  B = [[1, 0], [0, 0],
    [0, 1]],

whose value function is e^T P e with P from 0 = A^T P + P A - P B R^-1 B^T P + Q.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_continuous_are

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path import Path
from adp_path_follower.core.settings import CostSettings, TargetSettings

INPUT_MATRIX = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])  # B

_LEAST_COST = 1e-6  # of each error, relative: an error that costs nothing would never be corrected
_CURVATURE_STEP = 0.05  # [1/m] between two solutions of the table
_MOST_NODES = 65
_MOST_CURVATURE = 10.0  # [1/m] of the table: sharper bends are taken for this


def system_matrix(curvature: float, target: TargetSettings) -> FloatArray:
    """Return A of the error dynamics linearised about the path, shape (3, 3)."""
    speed, gain = target.desired_speed, target.target_gain
    return np.array(
        [
            [-gain, curvature * speed, 0.0],
            [-curvature * speed, 0.0, speed],
            [-gain * curvature, 0.0, 0.0],
        ]
    )


def riccati_solution(curvature: float, target: TargetSettings, cost: CostSettings) -> FloatArray:
    """Return P, shape (3, 3), at a curvature [1/m].

    Raises:
        SettingsError: The numbers are too extreme for a solution.

    """
    state_cost, input_cost = cost.state_cost_matrix(), cost.input_cost_matrix()
    state_cost = state_cost + _LEAST_COST * max(1.0, float(np.trace(state_cost))) * np.eye(3)
    system = system_matrix(curvature, target)
    try:
        solution = solve_continuous_are(system, INPUT_MATRIX, state_cost, input_cost)
    except (np.linalg.LinAlgError, ValueError):
        solution = np.full((3, 3), np.nan)
    if not np.isfinite(solution).all():
        raise SettingsError(
            "the Riccati equation has no solution in numbers for these 'state_cost', 'input_cost', "
            f"'desired_speed' and 'target_gain' at curvature {curvature:.3g} 1/m: choose values "
            "nearer to one another"
        )
    return np.asarray(0.5 * (solution + solution.T))


class RiccatiSchedule:
    """P over the range of a path's curvature, interpolated from a table.

    Attributes:
        table: P at equidistant curvatures, shape (K, 3, 3).

    """

    def __init__(self, path: Path, target: TargetSettings, cost: CostSettings) -> None:
        """Solve the Riccati equation over the curvatures of the path.

        Raises:
            SettingsError: As `riccati_solution`.

        """
        low, high = path.curvature_range
        low = max(min(low, 0.0), -_MOST_CURVATURE)  # the tangents beyond the ends are straight
        high = min(max(high, 0.0), _MOST_CURVATURE)
        count = int(np.clip(np.ceil((high - low) / _CURVATURE_STEP) + 1, 2, _MOST_NODES))
        nodes = np.linspace(low, high, count) if high > low else np.array([0.0, 1.0])
        self._start, self._step = float(nodes[0]), float(nodes[1] - nodes[0])
        table = [riccati_solution(float(node), target, cost) for node in nodes]
        self.table = np.array(table)

    def matrix(self, curvature: FloatArray) -> FloatArray:
        """Return P at curvatures [1/m] of any shape (...), shape (..., 3, 3)."""
        position = (curvature - self._start) / self._step
        position = np.fmin(np.fmax(position, 0.0), len(self.table) - 1.0)
        node = np.minimum(position.astype(np.intp), len(self.table) - 2)
        share = (position - node)[..., None, None]
        return np.asarray((1.0 - share) * self.table[node] + share * self.table[node + 1])
