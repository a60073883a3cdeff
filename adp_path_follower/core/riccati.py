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
from adp_path_follower.core.speed_profile import SpeedProfile

INPUT_MATRIX = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])  # B

_LEAST_COST = 1e-6  # of each error, relative: an error that costs nothing would never be corrected
_CURVATURE_STEP = 0.05  # [1/m] between two solutions of the table
_MOST_NODES = 65
_MOST_NODES_BY_SPEED = 17  # where the speed varies, for each of ...
_SPEED_NODES = 8  # ... so many speeds, in geometric progression
_MOST_CURVATURE = 10.0  # [1/m] of the table: sharper bends are taken for this


def system_matrix(
    curvature: float, target: TargetSettings, speed: float | None = None
) -> FloatArray:
    """Return A of the error dynamics linearised about the path, shape (3, 3)."""
    speed = target.desired_speed if speed is None else speed
    gain = target.target_gain
    return np.array(
        [
            [-gain, curvature * speed, 0.0],
            [-curvature * speed, 0.0, speed],
            [-gain * curvature, 0.0, 0.0],
        ]
    )


def riccati_solution(
    curvature: float, target: TargetSettings, cost: CostSettings, speed: float | None = None
) -> FloatArray:
    """Return P, shape (3, 3), at a curvature [1/m] and a speed [m/s], by default desired_speed.

    Raises:
        SettingsError: The numbers are too extreme for a solution.

    """
    state_cost, input_cost = cost.state_cost_matrix(), cost.input_cost_matrix()
    state_cost = state_cost + _LEAST_COST * max(1.0, float(np.trace(state_cost))) * np.eye(3)
    system = system_matrix(curvature, target, speed)
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
    """P over the range of a path's curvature and speed, interpolated from a table.

    Attributes:
        table: P at equidistant curvatures, shape (K, 3, 3); where the speed varies, for each of
            several speeds, shape (M, K, 3, 3).

    """

    def __init__(
        self,
        path: Path,
        target: TargetSettings,
        cost: CostSettings,
        profile: SpeedProfile | None = None,
    ) -> None:
        """Solve the Riccati equation over the curvatures of the path, and the speeds of a profile.

        Raises:
            SettingsError: As `riccati_solution`.

        """
        low, high = path.curvature_range
        low = max(min(low, 0.0), -_MOST_CURVATURE)  # the tangents beyond the ends are straight
        high = min(max(high, 0.0), _MOST_CURVATURE)
        varies = profile is not None and profile.varies
        most = _MOST_NODES_BY_SPEED if varies else _MOST_NODES
        count = int(np.clip(np.ceil((high - low) / _CURVATURE_STEP) + 1, 2, most))
        nodes = np.linspace(low, high, count) if high > low else np.array([0.0, 1.0])
        self._start, self._step = float(nodes[0]), float(nodes[1] - nodes[0])
        self._speeds: FloatArray | None = None  # logarithms
        if not varies:
            self.table = np.array([riccati_solution(float(node), target, cost) for node in nodes])
            return
        assert profile is not None  # it varies
        speeds = np.geomspace(profile.slowest, profile.highest, _SPEED_NODES)
        self._speeds = np.log(speeds)
        self.table = np.array(
            [
                [riccati_solution(float(node), target, cost, float(speed)) for node in nodes]
                for speed in speeds
            ]
        )

    def matrix(self, curvature: FloatArray, speed: FloatArray | None = None) -> FloatArray:
        """Return P at curvatures [1/m] and speeds [m/s] of shape (...), shape (..., 3, 3).

        Args:
            curvature: kappa; beyond the range of the table, what is at its end.
            speed: v_des; needed where it varies.

        """
        count = self.table.shape[-3]
        position = (curvature - self._start) / self._step
        position = np.fmin(np.fmax(position, 0.0), count - 1.0)
        node = np.minimum(position.astype(np.intp), count - 2)
        share = (position - node)[..., None, None]
        if self._speeds is None:
            return np.asarray((1.0 - share) * self.table[node] + share * self.table[node + 1])
        assert speed is not None  # as it varies
        level, part = self._level(speed)
        slow, fast = (
            (1.0 - share) * self.table[row, node] + share * self.table[row, node + 1]
            for row in (level, level + 1)
        )
        return np.asarray((1.0 - part) * slow + part * fast)

    def _level(self, speed: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """Return the row of the table below speeds (...), and how far above it they are."""
        assert self._speeds is not None  # as it varies
        first, step = self._speeds[0], self._speeds[1] - self._speeds[0]
        position = (np.log(np.maximum(speed, 1e-9)) - first) / step
        position = np.fmin(np.fmax(position, 0.0), _SPEED_NODES - 1.0)
        level = np.minimum(position.astype(np.intp), _SPEED_NODES - 2)
        return level, (position - level)[..., None, None]
