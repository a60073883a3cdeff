"""The optimum by Legendre-Gauss-Radau collocation and IPOPT.

The infinite-horizon problem is cut at a horizon after which nothing is left to win, and
transcribed on a mesh that is fine where the errors are large (what GPOPS does). A second mesh and
a second horizon say how exact the result is.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.interpolate import BarycentricInterpolator, KroghInterpolator

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.study.optimum.problem import Motion, OptimumError, Problem, casadi
from sim_unicycle.settings import PlantSettings

HORIZON = 30.0  # [s]
SETTLED = 1e-4  # relative change of J* with the horizon, below which it is that of any horizon

_LONGEST = 1000.0  # [s]: beyond, the mesh is too coarse where the errors are

_DEGREE = 5  # of the polynomials on each mesh interval
_INTERVALS = 40
_GRADING = 4.0  # logarithm of how much longer the last interval is than the first
_TOLERANCE = 1e-6  # relative change of J from one mesh to the next that counts as none
# The same where theta passes pi, at which the cost has a kink, and with limits of acceleration,
# with which commands have kinks.
_KINKED_TOLERANCE = 2e-5
_NOTHING = 1e-9  # a cost in which nothing is to be won: the start is on the path
_DENSITY_EXPONENT = 1.0 / 3.0  # of an interval's error, in how many intervals take its place
_KEPT = 0.3  # of a mesh's intervals that stay where they are
_MOST_MESHES = 16  # transcribed at a time


@dataclass(frozen=True)
class Optimum:
    """An optimal motion from one start.

    Attributes:
        motion: The motion at the start and at the collocation points, with its cost J*.
        mesh_change: Relative change of J from the mesh with half as many intervals.
        horizon_change: Relative change of J when the horizon is half as long again.
        intervals: Number of mesh intervals.
        guesses: J of each motion that starting guesses led to, best first, on a coarse mesh.

    """

    motion: Motion
    mesh_change: float
    horizon_change: float
    intervals: int
    guesses: tuple[float, ...]

    def __repr__(self) -> str:
        """Return J* and how exact it is in one line."""
        return (
            f"Optimum(J* {self.cost:.7g}, changes by {self.mesh_change:.0e} with the mesh and by "
            f"{self.horizon_change:.0e} with the horizon)"
        )

    @property
    def cost(self) -> float:
        """Return J*."""
        return self.motion.cost

    @property
    def local_optima(self) -> str:
        """Return a sentence about guesses that led to different motions, empty if none did."""
        if self.guesses[-1] <= self.guesses[0] * (1.0 + 1e-4) + 1e-9:
            return ""
        costs = ", ".join(f"{cost:.6g}" for cost in self.guesses)
        return f"the starting guesses led to different local optima: {costs}; the best counts"

    @property
    def settled(self) -> bool:
        """Return whether nothing is left to win after the horizon."""
        return self.horizon_change <= SETTLED


class OptimumSolver:
    """Optima from many starts at one place of a path; meshes are transcribed once.

    v_des, k1, Q, R and the limits are those of `settings`. The virtual target starts at
    `start_arc_length` [m]; after `horizon` [s] nothing is left to win. `plant`, by default ideal,
    is known with delay, lags, ramps, gains, bias and limits, and starts from rest.
    """

    def __init__(
        self,
        settings: Settings,
        path: Path,
        start_arc_length: float = 0.0,
        horizon: float = HORIZON,
        plant: PlantSettings | None = None,
    ) -> None:
        """Prepare; raise PathError or OptimumError for an impossible place or horizon."""
        robot = plant or PlantSettings()
        self._horizon = horizon - robot.command_delay  # that commands act
        path.check_place(start_arc_length)
        if not (self._horizon > 0.0 and horizon <= _LONGEST):
            raise OptimumError(
                f"horizon is {horizon} s, but must be above {robot.command_delay:g} and at most "
                f"{_LONGEST:g}"
            )
        self.problem = Problem(settings, path, start_arc_length, 1.5 * horizon, robot)
        self._mesh = functools.lru_cache(_MOST_MESHES)(functools.partial(_Mesh, self.problem))

    def solve(self, start: FloatArray, ways: Sequence[Motion] = ()) -> Optimum:
        """Return the optimal motion from an initial error [s, y, theta], shape (3,).

        `ways` are known motions from there, and further starting guesses. Raises OptimumError if no
        guess converged, or if J still changes with the mesh.
        """
        start = np.asarray(start, dtype=float)
        if start.shape != (3,) or not np.isfinite(start).all():
            raise OptimumError(f"start is {start.tolist()}, but must be finite values s, y, theta")
        standing = self.problem.standing(np.append(start, self.problem.start_arc_length))
        candidates = self._candidates(standing, ways)
        if not candidates:
            raise OptimumError(
                f"no optimum found from the start {start.tolist()}: the solver did not converge "
                "from any starting guess"
            )
        coarse, best = candidates[0]
        best, breaks, change = self._converged(coarse, best)
        longer = self._refined(best, _prolonged(breaks))
        return Optimum(
            motion=best.after(standing),
            mesh_change=change,
            horizon_change=_change(longer, best),
            intervals=len(breaks) - 1,
            guesses=tuple(motion.cost for _, motion in candidates),
        )

    def _candidates(self, standing: Motion, ways: Sequence[Motion]) -> list[tuple[Motion, Motion]]:
        """Return what starting guesses lead to, on a mesh and on one twice as fine, best first."""
        breaks = _graded(_INTERVALS // 2, self._horizon)
        coarse, fine = self._mesh(breaks), self._mesh(_halved(breaks))
        found: list[Motion] = []
        known = [way.at(standing.time[-1] + coarse.time) for way in ways]
        first = standing.state[-1]
        for guess in [*known, *self.problem.guesses(first[:3], coarse.time)]:
            motion = coarse.solve(guess.beginning_at(first))  # a robot may have begun elsewhere
            if motion is not None and all(_change(motion, other) > 1e-6 for other in found):
                found.append(motion)
        pairs = [(motion, fine.solve(motion.at(fine.time))) for motion in found]
        solved = [(first, second) for first, second in pairs if second is not None]
        return sorted(solved, key=lambda pair: pair[1].cost)

    def _converged(self, coarse: Motion, best: Motion) -> tuple[Motion, tuple[float, ...], float]:
        """Return motion, mesh and relative change of J, once halving intervals changes nothing."""
        breaks = _halved(_graded(_INTERVALS // 2, self._horizon))
        change = _change(best, coarse)
        turns = np.abs(best.state[:, 2]).max() > math.pi
        kinked = turns or self.problem.settings.motion.limited or not self.problem.robot.ideal
        tolerance = _KINKED_TOLERANCE if kinked else _TOLERANCE
        while change > tolerance:
            if len(breaks) > 4 * _INTERVALS:
                raise OptimumError(
                    f"optimum from the start {best.state[0, :3].tolist()} changes by {change:.1e} "
                    f"even on a mesh of {len(breaks) - 1} intervals: shorten the horizon, or "
                    "smooth the path where it bends sharply (path_tolerance)"
                )
            if len(breaks) > 2 * _INTERVALS:  # halving alone does not get far in a sharp bend
                breaks = self._mesh(breaks).redistributed(best)
                best = self._refined(best, breaks)
            breaks = _halved(breaks)
            finer = self._refined(best, breaks)
            change, best = _change(finer, best), finer
        return best, breaks, change

    def _refined(self, motion: Motion, breaks: tuple[float, ...]) -> Motion:
        """Return the optimum on another mesh, started from a motion."""
        mesh = self._mesh(breaks)
        refined = mesh.solve(motion.at(mesh.time))
        if refined is None:
            raise OptimumError(
                f"no optimum found from the start {motion.state[0, :3].tolist()} on "
                f"{len(breaks) - 1} intervals over {breaks[-1]:g} s"
            )
        return refined


def _change(motion: Motion, other: Motion) -> float:
    """Return by how much J differs, relative; 0 where both have nothing to win."""
    greater = max(motion.cost, other.cost)
    return 0.0 if greater < _NOTHING else abs(motion.cost - other.cost) / greater


def _graded(intervals: int, horizon: float) -> tuple[float, ...]:
    """Return the breaks [s] of a mesh that is fine where the errors are large."""
    growth = np.expm1(_GRADING * np.linspace(0.0, 1.0, intervals + 1))
    return tuple((horizon * growth / math.expm1(_GRADING)).tolist())


def _halved(breaks: tuple[float, ...]) -> tuple[float, ...]:
    middles = [0.5 * (first + last) for first, last in itertools.pairwise(breaks)]
    return tuple(sorted([*breaks, *middles]))


def _prolonged(breaks: tuple[float, ...]) -> tuple[float, ...]:
    """Return the same mesh with a horizon half as long again."""
    step = breaks[-1] - breaks[-2]
    more = max(1, math.ceil(0.5 * breaks[-1] / step))
    return (*breaks, *np.linspace(breaks[-1], 1.5 * breaks[-1], more + 1)[1:].tolist())


class _Mesh:
    """The transcribed problem on one mesh."""

    def __init__(self, problem: Problem, times: tuple[float, ...]) -> None:
        breaks = np.array(times)
        intervals, steps = len(breaks) - 1, np.diff(breaks)
        points = np.array(casadi.collocation_points(_DEGREE, "radau"))
        quadrature = np.array(casadi.collocation_coeff(points.tolist())[2]).ravel()
        self.time = np.append(0.0, (breaks[:-1, None] + steps[:, None] * points).ravel())
        count = intervals * _DEGREE
        values = casadi.MX.sym("values", 6, count + 1)  # state and wheels of every point
        here, unknown = (values[:4, 1:], values[4:, 1:]), casadi.vec(values)
        lengths = casadi.diag(np.repeat(steps, _DEGREE))
        rate, cost = problem.expressions.map(count)(*here)
        # Left to itself, CasADi finds the constraints' derivatives ten times as slowly.
        slope = problem.rate_slope.map(count)(*here) @ casadi.kron(lengths, casadi.DM.eye(6))
        blocks = casadi.diagcat(
            casadi.Sparsity(0, 6), *[problem.rate_slope.sparsity_out(0)] * count
        )
        constraints = _constraints(problem, steps, np.append(0.0, points))
        linear = casadi.DM(sparse.vstack([rows for rows, _, _ in constraints], "csc"))
        others = linear.shape[0] - 4 * count  # without the dynamics
        moved = casadi.vertcat(casadi.vec(rate @ lengths), casadi.MX(others, 1))
        by_values = casadi.vertcat(
            casadi.MX(blocks, slope.nz[:]), casadi.MX(others, unknown.shape[0])
        )
        (lower, upper), free = problem.limits(), np.full((count + 1, 4), math.inf)
        # The first velocity is free as far as rates allow; without any it counts nowhere.
        bounded = np.isfinite(problem.rates()[1]) | (problem.lags > 0.0)
        lowest, highest = np.where(bounded & (problem.lags == 0.0), problem.limits_at_rest(), 0.0)
        self._free_first = np.flatnonzero(~bounded)
        self._lower = np.hstack([-free, np.vstack([lowest, np.tile(lower, (count, 1))])])
        self._upper = np.hstack([free, np.vstack([highest, np.tile(upper, (count, 1))])])
        self._bounds = {
            "lbg": np.concatenate([low for _, low, _ in constraints]),
            "ubg": np.concatenate([high for _, _, high in constraints]),
        }
        defects = linear @ unknown - moved
        jacobian = casadi.Function(
            "jacobian", [unknown, casadi.MX(0, 1)], [defects, linear - by_values]
        )
        self._solver = casadi.nlpsol(
            "optimum",
            "ipopt",
            {"x": unknown, "f": cost @ np.kron(steps, quadrature), "g": defects},
            {
                "jac_g": jacobian,
                "print_time": False,
                "ipopt.print_level": 0,
                "ipopt.sb": "yes",
                "ipopt.tol": 1e-10,
                "ipopt.max_iter": 500,
            },
        )
        self._expressions, self._breaks, self._points = problem.expressions, breaks, points
        self._problem = problem

    def solve(self, guess: Motion) -> Motion | None:
        """Return the optimal motion from where a guess starts; None if none is found."""
        lower, upper = self._lower.copy(), self._upper.copy()
        lower[0, :4] = upper[0, :4] = guess.state[0]
        values = np.hstack([guess.state, self._wheels(guess)])
        result = self._solver(
            x0=values.ravel(), lbx=lower.ravel(), ubx=upper.ravel(), **self._bounds
        )
        if not self._solver.stats()["success"]:
            return None
        state, wheels = np.hsplit(np.array(result["x"]).reshape(-1, 6), [4])
        # No collocation point lies at the start: the first interval's polynomial gives its command.
        first = BarycentricInterpolator(self._points, wheels[1 : _DEGREE + 1])(0.0)
        wheels[0, self._free_first] = first[self._free_first]
        moved = np.stack(self._problem.robot.motion(*wheels.T), axis=1)
        modified = moved - self._problem.feedforward(state[:, 3])
        return Motion(float(result["f"]), self.time, state, modified)

    def _wheels(self, motion: Motion) -> FloatArray:
        """Return the wheels' velocities of a motion, shape (T, 2)."""
        moved = motion.modified_input + self._problem.feedforward(motion.state[:, 3])
        return np.stack(self._problem.robot.wheels(*moved.T), axis=1)

    def redistributed(self, motion: Motion) -> tuple[float, ...]:
        """Return a mesh with as many intervals, close where a motion's polynomials are wrong."""
        count = len(self._breaks) - 1
        share = np.maximum(self._errors(motion), 1e-300) ** _DENSITY_EXPONENT
        mass = _KEPT / count + (1.0 - _KEPT) * share / share.sum()
        along = np.append(0.0, np.cumsum(mass))
        breaks = np.interp(np.linspace(0.0, along[-1], count + 1), along, self._breaks)
        breaks[0], breaks[-1] = 0.0, self._breaks[-1]
        return tuple(breaks.tolist())

    def _errors(self, motion: Motion) -> FloatArray:
        """Return by how much the dynamics are missed between the points of each interval, (N,)."""
        steps = np.diff(self._breaks)
        nodes = np.append(0.0, self._points)
        between = 0.5 * (nodes[1:] + nodes[:-1])
        index = np.arange(len(steps))[:, None] * _DEGREE + np.arange(_DEGREE + 1)
        states = np.swapaxes(motion.state[index], 0, 1)  # (points, N, 4)
        wheels = np.swapaxes(self._wheels(motion)[index[:, 1:]], 0, 1)
        # Krogh's, for scipy 1.11 has no derivative of a barycentric one.
        curve = KroghInterpolator(nodes, states)
        state, slope = curve(between), curve.derivative(between)
        held = BarycentricInterpolator(self._points, wheels)(between)
        rate, _ = self._expressions.map(state.shape[0] * state.shape[1])(
            state.reshape(-1, 4).T, held.reshape(-1, 2).T
        )
        missed = slope - steps[:, None] * np.array(rate).T.reshape(state.shape)
        return np.asarray(np.abs(missed).max(axis=(0, 2)))


def _constraints(
    problem: Problem, steps: FloatArray, nodes: FloatArray
) -> list[tuple[Any, FloatArray, FloatArray]]:
    """Return the linear part of the constraints on state and wheels of all points: rows, low, high.

    First the dynamics: the slope over each interval, less step and rate. Then the command, v + lag
    v' of the wheels: limits of velocity hold at the collocation points, those of acceleration there
    and where intervals join. The nodes are those of all intervals, shape (6,).
    """
    intervals, slope_at = len(steps), KroghInterpolator(nodes, np.eye(len(nodes))).derivative(nodes)
    points = np.arange(intervals)[:, None] * _DEGREE + np.arange(_DEGREE + 1)
    gather = sparse.csr_matrix((np.ones(points.size), (np.arange(points.size), points.ravel())))
    each, per_second = sparse.eye(intervals), sparse.diags(1.0 / steps)
    slopes, zeros = sparse.kron(each, slope_at[1:]) @ gather, np.zeros(4 * intervals * _DEGREE)
    found = [(sparse.kron(slopes, np.eye(4, 6)), zeros, zeros)]
    (lower, upper), (slowest, fastest) = problem.limits(), problem.rates()
    lowest, highest = problem.limits_at_rest()
    ones = np.ones(intervals * _DEGREE)
    for row, lag in enumerate(problem.lags):
        column = np.eye(6)[4 + row]
        command = gather + lag * sparse.kron(per_second, slope_at) @ gather
        if lag > 0.0:
            held = sparse.kron(each, np.eye(_DEGREE + 1)[1:]) @ command
            found.append((sparse.kron(held, column), lower[row] * ones, upper[row] * ones))
        if math.isfinite(fastest[row]):
            change = sparse.kron(per_second, slope_at[1:]) @ command
            found.append((sparse.kron(change, column), slowest[row] * ones, fastest[row] * ones))
            if lag > 0.0:
                first, last = command[:: _DEGREE + 1], command[_DEGREE :: _DEGREE + 1]
                joint = first - sparse.vstack([0.0 * last[:1], last[:-1]])
                least, most = np.zeros((2, intervals))
                least[0], most[0] = lowest[row], highest[row]
                found.append((sparse.kron(joint, column), least, most))
    return found
