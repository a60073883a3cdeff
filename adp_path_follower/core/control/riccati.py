"""The Riccati solution along a path: a safe policy for every curvature, known before learning.

Linearised about the path, the error dynamics are e' = A(kappa) e + B u with

    A = [[-k1, kappa v_des, 0], [-kappa v_des, 0, v_des], [-k1 kappa, 0, 0]],  B = [[1, 0], [0, 0],
    [0, 1]],

whose value function is e^T P e with P from 0 = A^T P + P A - P B R^-1 B^T P + Q.
"""

import numpy as np
from scipy.linalg import solve_continuous_are

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.geometry import FloatArray, Number
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import CostSettings, TargetSettings

INPUT_MATRIX = np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])  # B

_EXACT = 1e-11  # residual of an exact solution, relative
_LEAST_COST = 1e-6  # of each error, relative: an error that costs nothing would never be corrected
_CURVATURE_STEP = 0.05  # [1/m] between two solutions of the table
_MOST_NODES = 65
_MOST_NODES_BY_SPEED = 17  # where the speed varies, for each of ...
_SPEED_NODES = 8  # ... so many speeds, in geometric progression
_MOST_CURVATURE = 10.0  # [1/m] of the table: sharper bends are taken for this


def system_matrix(curvature: float, target: TargetSettings, speed: float) -> FloatArray:
    """Return A of the error dynamics linearised about the path, shape (3, 3)."""
    gain = target.target_gain
    return np.array(
        [
            [-gain, curvature * speed, 0.0],
            [-curvature * speed, 0.0, speed],
            [-gain * curvature, 0.0, 0.0],
        ]
    )


def riccati_solution(
    curvature: float, speed: float, target: TargetSettings, cost: CostSettings
) -> FloatArray:
    """Return P (3, 3) at a curvature [1/m] and a speed [m/s]; SettingsError if there is none."""
    found = riccati_solutions(np.full(1, curvature), np.full(1, speed), target, cost)
    return np.asarray(found[0])


def riccati_solutions(
    curvature: FloatArray, speed: FloatArray, target: TargetSettings, cost: CostSettings
) -> FloatArray:
    """Return P at curvatures [1/m] and speeds [m/s], each of shape (N,), shape (N, 3, 3).

    All at once, as a control step waits for the table of a new path: by eigenvectors of the
    Hamiltonian matrices and a step of Newton's method (Kleinman). Where that is not exact, which is
    rare, scipy solves one by one. Raises SettingsError as `riccati_solution`.
    """
    state_cost, input_cost = cost.state_cost_matrix(), cost.input_cost_matrix()
    state_cost = state_cost + _LEAST_COST * max(1.0, float(np.trace(state_cost))) * np.eye(3)
    nodes = zip(curvature.tolist(), speed.tolist(), strict=True)
    systems = np.array([system_matrix(kappa, target, v_des) for kappa, v_des in nodes])
    with np.errstate(all="ignore"):  # numbers that are too extreme are looked for below
        solutions, exact = _by_eigenvectors(systems, state_cost, input_cost)
    for number in np.flatnonzero(~exact):
        try:
            solution = solve_continuous_are(systems[number], INPUT_MATRIX, state_cost, input_cost)
        except (np.linalg.LinAlgError, ValueError):
            solution = np.full((3, 3), np.nan)
        if not np.isfinite(solution).all():
            raise SettingsError(
                "the Riccati equation has no solution in numbers for these 'state_cost', "
                "'input_cost', 'desired_speed' and 'target_gain' at curvature "
                f"{curvature[number]:.3g} 1/m: choose values nearer to one another"
            )
        solutions[number] = solution
    return np.asarray(0.5 * (solutions + solutions.swapaxes(-1, -2)))


def _by_eigenvectors(
    systems: FloatArray, state_cost: FloatArray, input_cost: FloatArray
) -> tuple[FloatArray, np.ndarray]:
    """Return P for matrices A (N, 3, 3), and for which of them (N,) it is exact."""
    count = len(systems)
    failed = np.full((count, 3, 3), np.nan), np.zeros(count, dtype=bool)
    transposed = systems.swapaxes(-1, -2)
    try:
        gain = np.linalg.solve(input_cost, INPUT_MATRIX.T)  # R^-1 B^T
        hamiltonian = np.empty((count, 6, 6))
        hamiltonian[:, :3, :3], hamiltonian[:, :3, 3:] = systems, -INPUT_MATRIX @ gain
        hamiltonian[:, 3:, :3], hamiltonian[:, 3:, 3:] = -state_cost, -transposed
        values, vectors = np.linalg.eig(hamiltonian)
        order = np.argsort(values.real, axis=1)[:, :3]  # those of the closed loop, which decay
        stable = np.take_along_axis(vectors, order[:, None, :], axis=2)
        guess = np.linalg.solve(stable[:, :3].swapaxes(-1, -2), stable[:, 3:].swapaxes(-1, -2))
        feedback = gain @ guess.real.swapaxes(-1, -2)
        closed = systems - INPUT_MATRIX @ feedback
        right = state_cost + feedback.swapaxes(-1, -2) @ input_cost @ feedback
        # closed^T P + P closed = -right, by the Kronecker products with the unit matrix
        lyapunov = np.einsum("nki,jl->nijkl", closed, np.eye(3)) + np.einsum(
            "ik,nlj->nijkl", np.eye(3), closed
        )
        solutions = np.linalg.solve(lyapunov.reshape(count, 9, 9), -right.reshape(count, 9, 1))
    except np.linalg.LinAlgError:
        return failed
    solutions = solutions.reshape(count, 3, 3)
    products = transposed @ solutions, solutions @ INPUT_MATRIX @ gain @ solutions
    residual = products[0] + products[0].swapaxes(-1, -2) - products[1] + state_cost
    size = np.abs(products[1]).max(axis=(1, 2)) + np.abs(state_cost).max()
    exact = np.abs(residual).max(axis=(1, 2)) <= _EXACT * size
    # The equation has several solutions; only one with a decaying closed loop is positive definite.
    exact &= np.isfinite(solutions).all(axis=(1, 2))
    exact[exact] &= np.linalg.eigvalsh(solutions[exact]).min(axis=1) > 0.0
    return solutions, exact


class RiccatiSchedule:
    """P over a path's curvatures and speeds, interpolated from a table.

    `table` has P at K equidistant curvatures, (K, 3, 3), or at M speeds too, (M, K, 3, 3).
    """

    def __init__(
        self,
        path: Path,
        target: TargetSettings,
        cost: CostSettings,
        profile: SpeedProfile,
    ) -> None:
        """Solve the equation over the path's curvatures and a profile's speeds."""
        self.path = path
        self.profile = profile
        low, high = path.curvature_range
        low = max(min(low, 0.0), -_MOST_CURVATURE)  # the tangents beyond the ends are straight
        high = min(max(high, 0.0), _MOST_CURVATURE)
        most = _MOST_NODES_BY_SPEED if profile.varies else _MOST_NODES
        count = int(np.clip(np.ceil((high - low) / _CURVATURE_STEP) + 1, 2, most))
        nodes = np.linspace(low, high, count) if high > low else np.array([0.0, 1.0])
        self._start, self._step = float(nodes[0]), float(nodes[1] - nodes[0])
        self._speeds: FloatArray | None = None  # logarithms
        if not profile.varies:
            speeds = np.full(len(nodes), target.desired_speed)
            self.table = riccati_solutions(nodes, speeds, target, cost)
            return
        speeds = np.geomspace(profile.slowest, profile.highest, _SPEED_NODES)
        self._speeds = np.log(speeds)
        table = riccati_solutions(
            np.tile(nodes, len(speeds)), np.repeat(speeds, len(nodes)), target, cost
        )
        self.table = table.reshape(len(speeds), len(nodes), 3, 3)

    def matrix(self, curvature: FloatArray, speed: Number) -> FloatArray:
        """Return P (..., 3, 3) at curvatures [1/m], within the range, and speeds [m/s] (...)."""
        count = self.table.shape[-3]
        position = (curvature - self._start) / self._step
        if isinstance(position, float) and self._speeds is None:  # of one robot, as is quicker
            place = min(max(0.0, position), count - 1.0)  # 0 for NaN
            row = min(int(place), count - 2)
            part = place - row
            return np.asarray((1.0 - part) * self.table[row] + part * self.table[row + 1])
        position = np.fmin(np.fmax(position, 0.0), count - 1.0)
        node = np.minimum(position.astype(np.intp), count - 2)
        share = (position - node)[..., None, None]
        if self._speeds is None:
            return np.asarray((1.0 - share) * self.table[node] + share * self.table[node + 1])
        level, part = self._level(speed)
        slow, fast = (
            (1.0 - share) * self.table[row, node] + share * self.table[row, node + 1]
            for row in (level, level + 1)
        )
        return np.asarray((1.0 - part) * slow + part * fast)

    def _level(self, speed: Number) -> tuple[np.ndarray, FloatArray]:
        """Return the row of the table below speeds (...), and how far above it they are."""
        assert self._speeds is not None  # as it varies
        first, step = self._speeds[0], self._speeds[1] - self._speeds[0]
        position = (np.log(np.maximum(speed, 1e-9)) - first) / step
        position = np.fmin(np.fmax(position, 0.0), _SPEED_NODES - 1.0)
        level = np.minimum(position.astype(np.intp), _SPEED_NODES - 2)
        return level, (position - level)[..., None, None]
