"""Nonlinear model predictive control, the strongest peer; needs the extra `optimum` (CasADi)."""

from __future__ import annotations

import functools
import math
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path, PathFrame
from adp_path_follower.core.path.speed_profile import SpeedReference, passing_times
from adp_path_follower.core.settings.groups import CostSettings, Settings
from adp_path_follower.extras import Library
from adp_path_follower.study.comparison.peer import PeerController

_MOST_PASSES = 3  # of solving again with the curvature where the last pass has the target
_REACH = 0.05  # [m] to either side that parabolas of curvature and speed are made for
_LEAST_SPEED = 1e-3  # [m/s] whose square a parabola of v_des^2 counts at least
_FARTHEST = 20.0  # [m]: a robot farther away is taken to be there, where solvers still work
_NEAR = 0.5  # [m, rad]: from a plan that is farther away than this, no solver is warm-started
_DECAY = 1.0  # [1/s] of the errors in the first guess
casadi = Library("casadi", "the peer 'nmpc'", "optimum")
STEPS = 30
STEP = 0.1  # [s]
_MOST_ITERATIONS = 100  # one is enough on the path
_STATES, _INPUTS = 4, 2
_STAGE = _STATES + _INPUTS
_TERMS = 7  # place, and kappa and v_des^2 there with their first two derivatives
_QUIET = {"print_time": False, "error_on_fail": False, "show_eval_warnings": False}
_IPOPT = {
    **_QUIET,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-6,
    "ipopt.max_iter": _MOST_ITERATIONS,
}
_SQP = {
    **_QUIET,
    "qpsol": "qrqp",
    "qpsol_options": {"print_iter": False, "print_header": False, "error_on_fail": False},
    "max_iter": _MOST_ITERATIONS // 2,
    "print_header": False,
    "print_iteration": False,
    "print_status": False,
    "tol_du": 1e-5,
    "tol_pr": 1e-6,
}


@dataclass(frozen=True)
class Plan:
    """A predicted motion."""

    # s [m], y [m], theta [rad], s_p [m] before and after each step, shape (N + 1, 4).
    state: FloatArray
    command: FloatArray  # [v, w] that is held over each step [m/s, rad/s], shape (N, 2)

    def after(self, time: float) -> Plan:
        """Return the plan from a time [s] on, its last command held beyond its end."""
        shift = time / STEP
        nodes = np.arange(STEPS + 1) + shift
        state = np.stack([np.interp(nodes, range(STEPS + 1), row) for row in self.state.T], axis=1)
        beyond = np.maximum(nodes - STEPS, 0.0)
        state[:, 3] += beyond * (self.state[-1, 3] - self.state[-2, 3])
        command = [np.interp(nodes[:-1], range(STEPS), row) for row in self.command.T]
        return Plan(state, np.stack(command, axis=1))

    def turned_to(self, heading: float) -> Plan:
        """Return the plan by whole turns nearest to a heading error [rad], which is wrapped."""
        turns = round((heading - self.state[0, 2]) / (2.0 * math.pi))
        if turns == 0:
            return self
        return Plan(self.state + np.array([0.0, 0.0, 2.0 * math.pi * turns, 0.0]), self.command)


@dataclass(frozen=True)
class _Start:
    """A robot from which a plan begins."""

    state: FloatArray  # s [m], y [m], theta [rad], s_p [m], shape (4,)
    reach: FloatArray  # lowest and highest command [v, w] that may come first, shape (2, 2)
    reference: SpeedReference  # its speed along the path


class HorizonSolver:
    """Multiple shooting over the horizon: 30 steps of 0.1 s by RK4, commands held over each.

    The decision variables are [s, y, theta, s_p] and the command [v, w], so that limits are plain
    bounds, those of acceleration bounds of differences; curvature and v_des^2 in each step are
    parabolas in s_p, about where the plan that it starts from has the virtual target in that step.

    Median tick per robot on the figure eight at 20 Hz, on one core of a small server: 0.7 ms with
    sqpmethod and qrqp, compiled (2.7 ms if not), 1.7 to 3.1 ms with IPOPT. The fast one can fail
    from a guess that is metres away; hence IPOPT, 20 to 50 ms, where there is no good plan to start
    from.
    """

    def __init__(self, settings: Settings) -> None:
        """Take the solvers of the problem, and its limits."""
        limits, motion = settings.limits, settings.motion
        gain = settings.target.target_gain
        self._careful, self._fast, self.name = _solvers(gain, settings.cost, motion.limited)
        lower = np.full((STEPS, _STAGE), -math.inf)
        upper = np.full((STEPS, _STAGE), math.inf)
        lower[:, _STATES:], upper[:, _STATES:] = limits.lower, limits.upper
        free = np.full(_STATES, math.inf)
        self._lower = np.append(lower.ravel(), -free)
        self._upper = np.append(upper.ravel(), free)
        changes = (STEPS - 1) * motion.limited
        rise, fall = motion.max_linear_accel, motion.max_linear_decel
        if limits.lower[0] < 0.0:  # driving backwards, braking is a rise
            rise = fall = max(rise, fall)
        turn, exact = motion.max_angular_accel, np.zeros(_STATES * STEPS)
        self._least = np.append(exact, np.tile([-STEP * fall, -STEP * turn], changes))
        self._most = np.append(exact, np.tile([STEP * rise, STEP * turn], changes))

    def solve(
        self,
        start: FloatArray,
        guess: Plan,
        path: FloatArray,
        reach: FloatArray,
        terminal: FloatArray,
        careful: bool = False,
    ) -> Plan | None:
        """Return the best plan found from a guess; None if the solver fails.

        `start` is [s, y, theta, s_p], shape (4,). `path` has the `_TERMS` of each step, shape (N,
        7). `reach` has the lowest and the highest first command, shape (2, 2). `terminal` is P of
        the terminal cost e^T P e, shape (3, 3). `careful` takes the slower, safer solver, for a
        poor guess.
        """
        origin = np.array([0.0, 0.0, 0.0, start[3]])  # s_p from the start: small numbers
        values = np.hstack([guess.state[:-1] - origin, guess.command]).ravel()
        values = np.append(values, guess.state[-1] - origin)
        values[:_STATES] = start - origin
        lower, upper = self._lower.copy(), self._upper.copy()
        lower[:_STATES] = upper[:_STATES] = start - origin
        lower[_STATES:_STAGE], upper[_STATES:_STAGE] = reach
        values = np.clip(values, lower, upper)
        table = path - np.append(start[3], np.zeros(_TERMS - 1))
        parameters = np.concatenate([table.ravel(), terminal.ravel()])
        solver = self._careful if careful else self._fast
        bounds = {"lbg": self._least, "ubg": self._most}
        try:
            result = solver(x0=values, p=parameters, lbx=lower, ubx=upper, **bounds)
        except RuntimeError:
            return None
        found = np.array(result["x"]).ravel()
        if not (solver.stats()["success"] and np.isfinite(found).all()):
            return None
        stages = found[:-_STATES].reshape(STEPS, _STAGE)
        state = np.vstack([stages[:, :_STATES], found[-_STATES:]]) + origin
        return Plan(state, stages[:, _STATES:])


@functools.lru_cache(maxsize=8)
def _solvers(target_gain: float, cost: CostSettings, limited: bool) -> tuple[Any, Any, str]:
    """Return the safe solver, the fast one, compiled if there is a compiler, and its name."""
    problem = _transcription(target_gain, cost, limited)
    fast = casadi.nlpsol("nmpc", "sqpmethod", problem, _SQP)
    compiled = _compiled(fast)
    name = f"sqpmethod, {'not ' * (compiled is None)}compiled"
    return casadi.nlpsol("nmpc", "ipopt", problem, _IPOPT), compiled or fast, name


def _transcription(target_gain: float, cost: CostSettings, limited: bool) -> dict[str, Any]:
    """Return the nonlinear program as CasADi wants it, ordered stage by stage."""
    step = _step_function(target_gain, cost).map(STEPS)
    stages = casadi.MX.sym("stages", _STAGE, STEPS)  # [state, command] of each
    last = casadi.MX.sym("last", _STATES)
    table = casadi.MX.sym("path", _TERMS, STEPS)
    terminal = casadi.MX.sym("terminal", 3, 3)
    after, spent = step(stages[:_STATES, :], stages[_STATES:, :], table)
    gaps = casadi.horzcat(stages[:_STATES, 1:], last) - after
    changes = stages[_STATES:, 1:] - stages[_STATES:, :-1]
    return {
        "x": casadi.vertcat(casadi.vec(stages), last),
        "p": casadi.vertcat(casadi.vec(table), casadi.vec(terminal)),
        "f": casadi.sum2(spent) + casadi.bilin(terminal, last[:3], last[:3]),
        "g": casadi.vertcat(casadi.vec(gaps), *[casadi.vec(changes)] * limited),
    }


def _step_function(target_gain: float, cost: CostSettings) -> Any:
    """Return a CasADi function (state, command, path) -> (state after a step, its cost)."""
    state, command = casadi.SX.sym("state", _STATES), casadi.SX.sym("command", _INPUTS)
    table = casadi.SX.sym("path", _TERMS)

    def rates(now: Any) -> tuple[Any, Any]:
        s, y, theta, arc_length = casadi.vertsplit(now)
        ahead = arc_length - table[0]
        curvature = table[1] + ahead * (table[2] + 0.5 * ahead * table[3])
        squared = table[4] + ahead * (table[5] + 0.5 * ahead * table[6])
        v_des = casadi.sqrt(casadi.fmax(squared, _LEAST_SPEED**2))
        speed = v_des * casadi.cos(theta) + target_gain * s
        rate = casadi.vertcat(
            speed * (curvature * y - 1.0) + command[0] * casadi.cos(theta),
            command[0] * casadi.sin(theta) - curvature * s * speed,
            command[1] - curvature * speed,
            speed,
        )
        error, modified = now[:3], command - casadi.vertcat(v_des, v_des * curvature)
        spent = casadi.bilin(cost.state_cost_matrix(), error, error)
        return rate, spent + casadi.bilin(cost.input_cost_matrix(), modified, modified)

    first, first_cost = rates(state)
    second, second_cost = rates(state + 0.5 * STEP * first)
    third, third_cost = rates(state + 0.5 * STEP * second)
    fourth, fourth_cost = rates(state + STEP * third)
    after = state + STEP / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
    spent = STEP / 6.0 * (first_cost + 2.0 * second_cost + 2.0 * third_cost + fourth_cost)
    return casadi.Function("step", [state, command, table], [after, spent])


def _compiled(solver: Any) -> Any:
    """Return CasADi's solver with its functions compiled, or None without a working compiler."""
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        return None
    # Not CasADi's own just-in-time compilation, which leaves files in the working directory.
    generator = casadi.CodeGenerator("nmpc.c")
    generator.add(solver.oracle())
    for function in solver.get_function():
        generator.add(solver.get_function(function))
    with tempfile.TemporaryDirectory() as folder:
        generator.generate(folder + os.sep)
        source, library = os.path.join(folder, "nmpc.c"), os.path.join(folder, "nmpc.so")
        flags = ["-O1", "-march=native", "-fPIC", "-shared", "-lm"]
        # The library stays loaded after its file is gone.
        try:
            subprocess.run(  # noqa: S603  # the compiler of this machine
                [compiler, source, "-o", library, *flags], check=True, capture_output=True
            )
            return casadi.nlpsol("nmpc", "sqpmethod", library, _SQP)
        except (OSError, subprocess.CalledProcessError, RuntimeError):
            return None


class Nmpc(PeerController):
    """NMPC over 3 s, made for 20 Hz: 30 steps by RK4, Riccati terminal cost, limits as bounds.

    Each step starts from the last plan, shifted. Where the robot is not where it was planned to be,
    or the solver fails, a slower one starts from a plain guess; where that fails, too, the shifted
    plan stands.
    """

    def __init__(self, settings: Settings, path: Path, arc_length: ArrayLike = 0.0) -> None:
        """Transcribe and compile the solver; once for all with the same cost and k1."""
        super().__init__(settings, path, arc_length)
        self._schedule = RiccatiSchedule(
            path, settings.target, settings.cost, self.reference.profile
        )
        self._solver = HorizonSolver(settings)
        self.solver = self._solver.name  # such as "sqpmethod, compiled"
        self.failures = 0  # steps of any robot at which no new plan was found
        self._plans: list[Plan | None] = []

    def command(
        self, pose: FloatArray, dt: float, frame: PathFrame, error: FloatArray
    ) -> FloatArray:
        """Return the first command of each robot's plan."""
        away = np.hypot(error[..., 0], error[..., 1])
        nearer = error[..., :2] * (_FARTHEST / np.maximum(away, _FARTHEST))[..., None]
        arc_length = self.target.arc_length[..., None]
        starts = np.concatenate([nearer, error[..., 2:], arc_length], axis=-1)
        flat = starts.reshape(-1, starts.shape[-1])
        if len(self._plans) != len(flat):
            self._plans = [None] * len(flat)
        reach = np.swapaxes(self.reach(len(flat)), 0, 1)
        plans = []
        for number, last in enumerate(self._plans):
            start = _Start(flat[number], reach[number], self.reference.of_robot(number))
            plans.append(self._plan(start, last and last.after(dt)))
        self._plans = [*plans]
        commands = np.array([plan.command[0] for plan in plans])
        return commands.reshape(*pose.shape[:-1], 2)

    def _plan(self, start: _Start, shifted: Plan | None) -> Plan:
        """Return the plan of a robot, given its last one until now."""
        if shifted is not None:
            shifted = shifted.turned_to(start.state[2])
            if np.abs(shifted.state[0] - start.state).max() < _NEAR:
                found = self._solve(start, shifted, careful=False)
                if found is not None:
                    return found
        guess = self._guess(start)
        found = self._solve(start, guess, careful=True)
        if found is not None:
            return found
        self.failures += 1
        return guess if shifted is None else shifted

    def _solve(self, start: _Start, guess: Plan, careful: bool) -> Plan | None:
        """Return the best plan from a start, with curvature and speed along that plan itself."""
        for _ in range(_MOST_PASSES):
            places = 0.5 * (guess.state[1:, 3] + guess.state[:-1, 3])
            end = guess.state[-1, 3]
            terminal = self._schedule.matrix(self.path.curvature(end), start.reference.speed(end))
            along = self._along(places, start.reference)
            found = self._solver.solve(start.state, guess, along, start.reach, terminal, careful)
            if found is None:
                return None
            guess = found
            moved = 0.5 * (guess.state[1:, 3] + guess.state[:-1, 3]) - places
            if np.abs(moved).max() < _REACH:
                break
        return guess

    def _along(self, places: FloatArray, reference: SpeedReference) -> FloatArray:
        """Return the `_TERMS` at arc lengths (N,) [m], shape (N, 7)."""
        around = places + np.array([[-_REACH], [0.0], [_REACH]])
        squared = np.square(np.broadcast_to(reference.speed(around), around.shape))
        columns = [places]
        for behind, here, ahead in (self.path.curvature(around), squared):
            bend = (ahead - 2.0 * here + behind) / _REACH**2
            columns += [here, (ahead - behind) / (2.0 * _REACH), bend]
        return np.column_stack(columns)

    def _guess(self, start: _Start) -> Plan:
        """Return a plan on which the errors die away and the robot just drives on."""
        time = STEP * np.arange(STEPS + 1)
        error = np.exp(-_DECAY * time)[:, None] * start.state[:3]
        reference = start.reference
        places = np.linspace(0.0, reference.profile.highest * time[-1], 10 * STEPS + 1)
        places += start.state[3]
        arc_length = np.interp(time, passing_times(reference, places), places)
        here = arc_length[:-1]
        command = error_dynamics.feedforward(self.path.curvature(here), reference.speed(here))
        return Plan(np.column_stack([error, arc_length]), command)
