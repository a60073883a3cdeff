"""The optimal control problem offline, and motions to start a search from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.interface import ControlOutput
from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.control.riccati import riccati_solution
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray, wrap_angle
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.extras import Library
from adp_path_follower.study.simulation.simulate import Observer

casadi = Library("casadi", "the offline optimum", "optimum")

_MARGIN = 10.0  # [m] of path behind and ahead of what the desired speed covers
_SPACING = 0.005  # [m] of the curvature's knots: at 2 cm J* was 1e-4 wrong round a corner
_LONGEST = 2000.0  # [m] of path whose curvature is prepared


class OptimumError(AdpError):
    """Report an optimum that was not found."""


@dataclass(frozen=True)
class Motion:
    """A motion over time."""

    cost: float  # J, infinite for a guess
    time: FloatArray  # shape (T,) [s]
    state: FloatArray  # s [m], y [m], theta [rad], s_p [m], shape (T, 4)
    modified_input: FloatArray  # u = [v_e, w_e], shape (T, 2)

    def at(self, time: FloatArray) -> Motion:
        """Return the motion at other times, going straight on beyond its end."""
        state = np.stack([np.interp(time, self.time, column) for column in self.state.T], axis=1)
        beyond = np.maximum(time - self.time[-1], 0.0)
        state[:, 3] += (
            beyond * (self.state[-1, 3] - self.state[-2, 3]) / (self.time[-1] - self.time[-2])
        )
        columns = [np.interp(time, self.time, column) for column in self.modified_input.T]
        return Motion(self.cost, time, state, np.stack(columns, axis=1))


class Problem:
    """The optimal control problem in the target's frame, as numbers and as CasADi expressions."""

    def __init__(
        self, settings: Settings, path: Path, start_arc_length: float, horizon: float
    ) -> None:
        """Prepare the path's curvature from the start to what is reached in a time [s]."""
        self.settings, self.path = settings, path
        self.start_arc_length = start_arc_length
        self.state_cost = settings.cost.state_cost_matrix()
        self.input_cost = settings.cost.input_cost_matrix()
        covered = settings.target.desired_speed * horizon + 2.0 * _MARGIN
        if covered > _LONGEST:
            raise OptimumError(
                f"the robot covers {covered:.3g} m within the horizon, but at most {_LONGEST:g} m "
                "can be optimised: give a shorter horizon"
            )
        first = start_arc_length - _MARGIN
        knots = np.arange(first, first + covered, _SPACING)
        self._curvature = casadi.interpolant("curvature", "bspline", [knots], path.curvature(knots))

    def expressions(self) -> Any:
        """Return a CasADi function (state, u) -> (state', running cost, angular velocity)."""
        state, u = casadi.MX.sym("state", 4), casadi.MX.sym("u", 2)
        s, y, theta, arc_length = casadi.vertsplit(state)
        target = self.settings.target
        curvature, v_des = self._curvature(arc_length), target.desired_speed
        speed = v_des * casadi.cos(theta) + target.target_gain * s
        rate = casadi.vertcat(
            speed * (curvature * y - 1.0) + (v_des + u[0]) * casadi.cos(theta),
            (v_des + u[0]) * casadi.sin(theta) - curvature * s * speed,
            curvature * (v_des - speed) + u[1],
            speed,
        )
        # As everybody's cost does it, whichever way round the robot turns.
        wrapped = theta - 2.0 * math.pi * casadi.floor((theta + math.pi) / (2.0 * math.pi))
        error = casadi.vertcat(s, y, wrapped)
        cost = casadi.bilin(self.state_cost, error, error) + casadi.bilin(self.input_cost, u, u)
        return casadi.Function("problem", [state, u], [rate, cost, u[1] + curvature * v_des])

    def guesses(self, start: FloatArray, time: FloatArray) -> list[Motion]:
        """Return Riccati's motion, a fast and a slow decay; facing backwards, for each turn."""
        v_des = self.settings.target.desired_speed
        arc_length = self.start_arc_length + v_des * time
        motions = []
        for turned in _windings(start):
            motions.append(self._riccati_motion(turned, time))
            for rate in (1.0, 0.3):
                error = np.exp(-rate * time)[:, None] * turned
                state = np.column_stack([error, arc_length])
                motions.append(Motion(math.inf, time, state, np.zeros((len(time), 2))))
        return motions

    def _riccati_motion(self, start: FloatArray, time: FloatArray) -> Motion:
        """Return the motion of the Riccati policy, with its errors bounded to stay a guess."""
        target, limits = self.settings.target, self.settings.limits
        v_des = target.desired_speed
        solution = riccati_solution(0.0, v_des, target, self.settings.cost)
        gain = np.linalg.solve(self.input_cost, solution[[0, 2]])
        fine = np.arange(0.0, time[-1] + 0.02, 0.02)
        state = np.empty((len(fine), 4))
        inputs = np.empty((len(fine), 2))
        state[0] = [*start, self.start_arc_length]
        for step in range(len(fine)):
            curvature = self.path.curvature(state[step, 3])
            forward = error_dynamics.feedforward(curvature, v_des)
            inputs[step] = saturate(-gain @ state[step, :3], forward, limits)
            if step + 1 < len(fine):
                zeta = np.append(state[step, :3], 0.0)
                rate = error_dynamics.drift(zeta, curvature, target, v_des)
                rate[:3] += (error_dynamics.input_matrix(zeta) @ inputs[step])[:3]
                speed = error_dynamics.target_speed(zeta, target, v_des)
                state[step + 1, :3] = np.clip(state[step, :3] + 0.02 * rate[:3], -20.0, 20.0)
                state[step + 1, 3] = state[step, 3] + 0.02 * speed
        return Motion(math.inf, fine, state, inputs).at(time)


def _windings(start: FloatArray) -> list[FloatArray]:
    """Return a start [s, y, theta], shape (3,), with each theta from which it is worth turning."""
    theta = float(start[2])
    if abs(theta) > math.pi:
        theta = float(wrap_angle(theta))
    turns = [theta]
    if abs(theta) > 0.5 * math.pi:
        turns.append(theta - math.copysign(2.0 * math.pi, theta))
    return [np.array([start[0], start[1], turn]) for turn in turns]


class Ways:
    """The motions of all controllers from each start: guesses for the optimum."""

    def __init__(self, starts: int) -> None:
        """Expect runs from so many starts."""
        self._steps: list[list[list[FloatArray]]] = [[] for _ in range(starts)]

    def of_another(self, known: np.ndarray) -> Observer:
        """Return what takes down the runs of another controller from the known starts (B,)."""
        numbers = np.flatnonzero(known)
        for steps in self._steps:
            steps.append([])

        def observe(runs: slice, time: float, pose: FloatArray, output: ControlOutput) -> None:
            times, arc_length = np.full((len(pose), 1), time), output.arc_length[:, None]
            rows = np.hstack([times, output.error, arc_length, output.modified_input])
            for number, row in zip(numbers[runs].tolist(), rows, strict=True):
                self._steps[number][-1].append(row)

        return observe

    def motions(self, start: int) -> list[Motion]:
        """Return the motions from a start, without those that were lost."""
        found = []
        for steps in self._steps[start]:
            rows = np.array(steps)
            if len(rows) and np.isfinite(rows).all():
                state, heading = rows[:, 1:5].copy(), np.unwrap(rows[:, 3])
                state[:, 2] = heading - 2.0 * math.pi * round(heading[-1] / (2.0 * math.pi))
                found.append(Motion(math.inf, rows[:, 0], state, rows[:, 5:]))
        return found
