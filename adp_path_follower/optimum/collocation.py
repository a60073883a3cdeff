"""The optimum by Legendre-Gauss-Radau collocation and IPOPT.

The infinite-horizon problem is cut at a horizon after which nothing is left to win, and
transcribed on a mesh that is fine where the errors are large (what GPOPS does). A second mesh and
a second horizon say how exact the result is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from scipy.interpolate import BarycentricInterpolator

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path import Path
from adp_path_follower.core.settings import Settings
from adp_path_follower.optimum.problem import Motion, OptimumError, Problem

HORIZON = 30.0  # [s]

_DEGREE = 5  # of the polynomials on each mesh interval
_INTERVALS = 40
_GRADING = 4.0  # logarithm of how much longer the last interval is than the first
_TOLERANCE = 1e-6  # relative change of J from one mesh to the next that counts as none


@dataclass(frozen=True)
class Optimum:
    """An optimal motion from one start.

    Attributes:
        motion: The motion at the start and at the collocation points, with its cost J*.
        mesh_change: Relative change of J from the mesh with half as many intervals.
        horizon_change: Relative change of J when the horizon is half as long again.
        intervals: Number of mesh intervals.
        guesses: J from each starting guess that converged, best first.

    """

    motion: Motion
    mesh_change: float
    horizon_change: float
    intervals: int
    guesses: tuple[float, ...]

    @property
    def cost(self) -> float:
        """Return J*."""
        return self.motion.cost

    @property
    def has_local_optima(self) -> bool:
        """Return whether starting guesses led to different motions."""
        return self.guesses[-1] > self.guesses[0] * (1.0 + 1e-4) + 1e-9


def solve_optimum(
    settings: Settings,
    path: Path,
    start: FloatArray,
    start_arc_length: float = 0.0,
    horizon: float = HORIZON,
) -> Optimum:
    """Return the optimal motion from a start.

    Args:
        settings: v_des, k1, Q, R and the limits; everything else is the controller's own.
        path: The path.
        start: Initial error [s, y, theta], shape (3,).
        start_arc_length: Where the virtual target starts [m].
        horizon: Time [s] after which nothing is left to win.

    Raises:
        OptimumError: No starting guess converged, or J still changes with the mesh.

    """
    return OptimumSolver(settings, path, start_arc_length, horizon).solve(start)


class OptimumSolver:
    """Optima from many starts at one place of a path; meshes are transcribed once."""

    def __init__(
        self,
        settings: Settings,
        path: Path,
        start_arc_length: float = 0.0,
        horizon: float = HORIZON,
    ) -> None:
        """Prepare; see `solve_optimum`."""
        if not (math.isfinite(start_arc_length) and 0.0 < horizon < math.inf):
            raise OptimumError(
                f"start_arc_length is {start_arc_length} m and horizon {horizon} s, but they must "
                "be finite, the horizon above 0"
            )
        self.problem = Problem(settings, path, start_arc_length, 1.5 * horizon)
        self._horizon = horizon
        self._meshes: dict[tuple[int, float], _Mesh] = {}

    def solve(self, start: FloatArray) -> Optimum:
        """Return the optimal motion from an initial error [s, y, theta], shape (3,).

        Raises:
            OptimumError: See `solve_optimum`.

        """
        start = np.asarray(start, dtype=float)
        if start.shape != (3,) or not np.isfinite(start).all():
            raise OptimumError(f"start is {start.tolist()}, but must be finite values s, y, theta")
        intervals = _INTERVALS // 2
        coarse = self._mesh(intervals, self._horizon)
        found = [
            motion
            for guess in self.problem.guesses(start, coarse.time)
            if (motion := coarse.solve(start, guess)) is not None
        ]
        if not found:
            raise OptimumError(
                f"no optimum found from the start {start.tolist()}: the solver did not converge "
                "from any starting guess"
            )
        found.sort(key=lambda motion: motion.cost)
        best, change = found[0], math.inf
        while change > _TOLERANCE:
            intervals *= 2
            if intervals > 8 * _INTERVALS:
                raise OptimumError(
                    f"optimum from the start {start.tolist()} changes by {change:.1e} even on a "
                    f"mesh of {intervals // 2} intervals: shorten the horizon"
                )
            finer = self._refined(best, intervals, self._horizon, start)
            change, best = abs(finer.cost - best.cost) / max(finer.cost, 1e-12), finer
            if finer.cost < 1e-9:  # the start is on the path: nothing to win, nothing to compare
                break
        longer = self._refined(best, intervals, 1.5 * self._horizon, start)
        return Optimum(
            motion=best,
            mesh_change=change if math.isfinite(change) else 0.0,
            horizon_change=abs(longer.cost - best.cost) / max(best.cost, 1e-12),
            intervals=intervals,
            guesses=tuple(motion.cost for motion in found),
        )

    def _refined(self, motion: Motion, intervals: int, horizon: float, start: FloatArray) -> Motion:
        """Return the optimum on another mesh, started from a motion."""
        mesh = self._mesh(intervals, horizon)
        refined = mesh.solve(start, motion.at(mesh.time))
        if refined is None:
            raise OptimumError(
                f"no optimum found from the start {start.tolist()} on {intervals} intervals over "
                f"{horizon:g} s"
            )
        return refined

    def _mesh(self, intervals: int, horizon: float) -> _Mesh:
        key = intervals, horizon
        if key not in self._meshes:
            self._meshes[key] = _Mesh(self.problem, intervals, horizon)
        return self._meshes[key]


class _Mesh:
    """The transcribed problem on one mesh; the start is a parameter."""

    def __init__(self, problem: Problem, intervals: int, horizon: float) -> None:
        growth = np.expm1(_GRADING * np.linspace(0.0, 1.0, intervals + 1))
        breaks = horizon * growth / math.expm1(_GRADING)
        steps = np.diff(breaks)
        points = np.array(casadi.collocation_points(_DEGREE, "radau"))
        derivative, _, quadrature = casadi.collocation_coeff(points.tolist())
        self.time = np.append(0.0, (breaks[:-1, None] + steps[:, None] * points).ravel())
        count = intervals * _DEGREE
        state = casadi.MX.sym("state", 4, count + 1)
        inputs = casadi.MX.sym("inputs", 2, count)
        start = casadi.MX.sym("start", 4)
        rate, cost, angular = problem.expressions().map(count)(state[:, 1:], inputs)
        defects, total = [state[:, 0] - start], 0.0
        for index, step in enumerate(steps):
            first, last = index * _DEGREE, (index + 1) * _DEGREE
            slope = state[:, first : last + 1] @ derivative
            defects.append(casadi.vec(slope - step * rate[:, first:last]))
            total += step * (cost[:, first:last] @ quadrature)
        limits, v_des = problem.settings.limits, problem.settings.target.desired_speed
        self._bounds: dict[str, Any] = {}
        equalities = 4 * (count + 1)
        bound = np.zeros(equalities)
        self._bounds["lbg"], self._bounds["ubg"] = bound, bound
        if math.isfinite(limits.max_angular_vel):
            defects.append(angular.T)
            turn = np.full(count, limits.max_angular_vel)
            self._bounds["lbg"] = np.append(bound, -turn)
            self._bounds["ubg"] = np.append(bound, turn)
        free = np.full(equalities, math.inf)
        self._bounds["lbx"] = np.append(
            -free, np.tile([limits.min_linear_vel - v_des, -math.inf], count)
        )
        self._bounds["ubx"] = np.append(
            free, np.tile([limits.max_linear_vel - v_des, math.inf], count)
        )
        self._solver = casadi.nlpsol(
            "optimum",
            "ipopt",
            {
                "x": casadi.vertcat(casadi.vec(state), casadi.vec(inputs)),
                "p": start,
                "f": total,
                "g": casadi.vertcat(*defects),
            },
            {
                "print_time": False,
                "ipopt.print_level": 0,
                "ipopt.sb": "yes",
                "ipopt.tol": 1e-10,
                "ipopt.max_iter": 500,
            },
        )
        self._problem, self._points = problem, points

    def solve(self, start: FloatArray, guess: Motion) -> Motion | None:
        """Return the optimal motion found from a guess; None if there is none."""
        values = np.append(guess.state.ravel(), guess.modified_input[1:].ravel())
        place = [*start, self._problem.start_arc_length]
        result = self._solver(x0=values, p=place, **self._bounds)
        if not self._solver.stats()["success"]:
            return None
        found = np.array(result["x"]).ravel()
        state = found[: guess.state.size].reshape(-1, 4)
        inputs = found[guess.state.size :].reshape(-1, 2)
        # No collocation point lies at the start: the first interval's polynomial gives its input.
        first = BarycentricInterpolator(self._points, inputs[:_DEGREE])(0.0)
        return Motion(float(result["f"]), self.time, state, np.vstack([first, inputs]))
