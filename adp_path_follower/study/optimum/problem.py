"""The optimal control problem offline, and motions to start a search from.

It is written in the velocities [v, w] of the wheels. Their command is v + lag v', whose change a
ramp bounds. A robot with a delay stands still until its first command acts.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.actuation import limited_command
from adp_path_follower.core.control.policy import within
from adp_path_follower.core.control.riccati import riccati_solution
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray, wrap_angle
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.speed_profile import passing_times, speed_from_rest
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.extras import Library
from adp_path_follower.study.simulation.trajectories import Trajectories
from sim_unicycle.settings import PlantSettings

casadi = Library("casadi", "the offline optimum", "optimum")

_MARGIN = 10.0  # [m] of path behind and ahead of what the desired speed covers
_SPACING = 0.005  # [m] of the knots: at 2 cm J* was 1e-4 wrong round a corner
_LONGEST = 2000.0  # [m] of path whose curvature and speed are prepared
_STEP = 0.02  # [s] of a guess
_ROUND = (
    2e-5  # [m] of corners of v_des^2: at 1e-4 J* was 4e-5 too low, without it IPOPT went astray
)
_LEAST_SPEED = 1e-3  # [m/s] whose square v_des^2 is not below, where splines swing


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

    def after(self, first: Motion) -> Motion:
        """Return another motion, and this one after it."""
        return Motion(
            first.cost + self.cost,
            np.append(first.time, first.time[-1] + self.time[1:]),
            np.vstack([first.state, self.state[1:]]),
            np.vstack([first.modified_input[:-1], self.modified_input]),
        )

    def beginning_at(self, start: FloatArray) -> Motion:
        """Return the motion from s, y, theta, s_p, shape (4,); its own turns of theta stay."""
        state = self.state.copy()
        turns = np.round((state[0, 2] - start[2]) / (2.0 * math.pi))
        state[0] = start + np.array([0.0, 0.0, 2.0 * math.pi * turns, 0.0])
        return replace(self, state=state)


class Problem:
    """The optimal control problem in the target's frame, as numbers and as CasADi expressions."""

    def __init__(
        self,
        settings: Settings,
        path: Path,
        start_arc_length: float,
        horizon: float,
        plant: PlantSettings,
    ) -> None:
        """Prepare curvature and speed of the path from the start to what is reached in a time [s].

        Raises OptimumError for settings or a path that the problem does not know.
        """
        self.settings, self.path = settings, path
        self.robot, self._plant = plant.model, plant
        self.lags = np.array([self.robot.linear_lag, self.robot.angular_lag])
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
        self.reference = speed_from_rest(path, settings, start_arc_length)
        self._ahead = np.append(start_arc_length, knots[knots > start_arc_length])
        self._passing = passing_times(self.reference, self._ahead)
        end = float(np.interp(path.length, self._ahead, self._passing))  # [s]
        _refuse_unknown(settings, self.reference.stops and end < horizon)
        self._curvature = casadi.interpolant("curvature", "bspline", [knots], path.curvature(knots))
        if self.reference.varies:  # squares, for they are linear under a constant acceleration
            squares = np.square(self.reference.profile.speed(knots)) + np.zeros(len(knots))
            self._profile = casadi.interpolant("profile", "bspline", [knots], squares)

    @functools.cached_property
    def expressions(self) -> Any:
        """Return a CasADi function (state, wheels' [v, w]) -> (state', running cost)."""
        state, wheels = casadi.MX.sym("state", 4), casadi.MX.sym("wheels", 2)
        arc_length, v_des = state[3], casadi.MX(self.settings.target.desired_speed)
        if self.reference.varies:
            squared = casadi.fmax(self._profile(arc_length), _LEAST_SPEED**2)
            launched = self.reference.start
            if launched is not None and math.isfinite(self.reference.rise):
                start, least = launched  # exact, for near rest the target goes away from errors
                run = _greater(arc_length - float(start), 0.0, _ROUND)
                reached = least + self.reference.rise * run
                squared = -_greater(-squared, -reached, self.reference.rise * _ROUND)
            v_des = casadi.sqrt(squared)
        found = self._along(state, wheels, self._curvature(arc_length), v_des)
        return casadi.Function("problem", [state, wheels], found)

    @functools.cached_property
    def _along(self) -> Any:
        """Return the function (state, wheels, curvature, v_des) -> (state', running cost)."""
        state, wheels, curvature, v_des = (casadi.SX.sym("x", size) for size in (4, 2, 1, 1))
        linear, angular = self.robot.motion(wheels[0], wheels[1])
        s, y, theta, _ = casadi.vertsplit(state)
        speed = v_des * casadi.cos(theta) + self.settings.target.target_gain * s
        rate = casadi.vertcat(
            speed * (curvature * y - 1.0) + linear * casadi.cos(theta),
            linear * casadi.sin(theta) - curvature * s * speed,
            angular - curvature * speed,
            speed,
        )
        u = casadi.vertcat(linear - v_des, angular - v_des * curvature)
        # As everybody's cost does it, whichever way round the robot turns.
        wrapped = theta - 2.0 * math.pi * casadi.floor((theta + math.pi) / (2.0 * math.pi))
        error = casadi.vertcat(s, y, wrapped)
        cost = casadi.bilin(self.state_cost, error, error) + casadi.bilin(self.input_cost, u, u)
        return casadi.Function("along", [state, wheels, curvature, v_des], [rate, cost])

    @functools.cached_property
    def rate_slope(self) -> Any:
        """Return a CasADi function (state, wheels' [v, w]) -> derivatives of state' by them."""
        state, wheels = casadi.MX.sym("state", 4), casadi.MX.sym("wheels", 2)
        rate, _ = self.expressions(state, wheels)
        slope = casadi.horzcat(casadi.jacobian(rate, state), casadi.jacobian(rate, wheels))
        return casadi.Function("rate_slope", [state, wheels], [slope])

    def feedforward(self, arc_length: FloatArray) -> FloatArray:
        """Return [v_ss, w_ss] at arc lengths (T,) [m], shape (T, 2)."""
        return error_dynamics.feedforward(
            self.path.curvature(arc_length), self.reference.speed(arc_length)
        )

    def limits(self) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and the highest command [v, w], shape (2,)."""
        limits, plant = self.settings.limits, self._plant
        lower = np.array([plant.min_linear_vel, -plant.max_angular_vel])
        upper = np.array([plant.max_linear_vel, plant.max_angular_vel])
        return np.maximum(limits.lower, lower), np.minimum(limits.upper, upper)

    def limits_at_rest(self) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and the highest first command [v, w] (2,) that accelerations allow.

        A command that is held rises at once by what a period allows: half a period ahead of a ramp.
        """
        slowest, fastest = self.rates()
        half = 0.5 / self.settings.controller.controller_frequency
        lower, upper = self.limits()
        return np.maximum(half * slowest, lower), np.minimum(half * fastest, upper)

    def rates(self) -> tuple[FloatArray, FloatArray]:
        """Return the lowest and the highest rate of the command, shape (2,) [m/s^2, rad/s^2]."""
        motion, plant = self.settings.motion, self._plant
        robot = np.minimum(self.robot.ramps, [plant.max_linear_accel, plant.max_angular_accel])
        lower = [motion.max_linear_decel, motion.max_angular_accel]
        upper = [motion.max_linear_accel, motion.max_angular_accel]
        return -np.minimum(lower, robot), np.minimum(upper, robot)

    def standing(self, start: FloatArray) -> Motion:
        """Return the motion from s, y, theta, s_p, shape (4,), until the first command acts."""
        delay = self.robot.delay
        time = np.linspace(0.0, delay, 1 + math.ceil(delay / _STEP))
        if not delay:
            return Motion(0.0, time, start[None], -self.feedforward(start[None, 3]))

        def rates(_: float, values: FloatArray) -> FloatArray:
            rate, cost = self.expressions(values[:4], np.zeros(2))
            return np.append(np.array(rate).ravel(), float(cost))

        start_and_cost = np.append(start, 0.0)
        found = solve_ivp(rates, (0.0, delay), start_and_cost, t_eval=time, rtol=1e-9, atol=1e-9)
        state = found.y[:4].T
        return Motion(float(found.y[4, -1]), time, state, -self.feedforward(state[:, 3]))

    def guesses(self, start: FloatArray, time: FloatArray) -> list[Motion]:
        """Return Riccati's motion, a fast and a slow decay; facing backwards, for each turn."""
        arc_length = np.interp(time, self._passing, self._ahead)
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
        target, limits, motion = self.settings.target, self.settings.limits, self.settings.motion
        solution = riccati_solution(0.0, target.desired_speed, target, self.settings.cost)
        gain = np.linalg.solve(self.input_cost, solution[[0, 2]])
        fine = np.arange(0.0, time[-1] + _STEP, _STEP)
        command = np.zeros(2)
        state, inputs = np.empty((len(fine), 4)), np.empty((len(fine), 2))
        error, place = start, np.asarray(self.start_arc_length)[()]
        for step in range(len(fine)):
            state[step, :3], state[step, 3] = error, place
            curvature, v_des = self.path.curvature(place), self.reference.speed(place)
            forward = error_dynamics.feedforward(curvature, v_des)
            wanted = within(forward - gain.dot(error), limits)
            if motion.limited:
                wanted = limited_command(wanted, command, np.zeros(2), limits, motion, _STEP)
            command, inputs[step] = wanted, wanted - forward
            s, y, theta = error.tolist()
            v, w = wanted.tolist()
            speed = v_des * math.cos(theta) + target.target_gain * s
            along, across = v * math.cos(theta) - speed, v * math.sin(theta)
            turn = curvature * speed
            rate = np.array([along + turn * y, across - turn * s, w - turn])
            error = np.minimum(np.maximum(error + _STEP * rate, -20.0), 20.0)
            place = place + _STEP * speed
        return Motion(math.inf, fine, state, inputs).at(time)


def _greater(first: Any, second: Any, rounding: float) -> Any:
    """Return the greater of two expressions, its corner rounded by half of `rounding`."""
    return 0.5 * (first + second + casadi.sqrt((first - second) ** 2 + rounding**2))


def _refuse_unknown(settings: Settings, ends: bool) -> None:
    """Raise OptimumError for limits, and for a robot that stops, which the optimum cannot tell."""
    motion, reverses = settings.motion, settings.limits.lower[0] < 0.0
    if motion.jerk_limited:
        raise OptimumError(
            "the optimum knows no limits of jerk: set max_linear_jerk and max_angular_jerk to .inf"
        )
    if reverses and motion.max_linear_accel != motion.max_linear_decel:
        raise OptimumError(
            "for a robot that may drive backwards the optimum knows one limit of acceleration: set "
            "max_linear_accel and max_linear_decel to the same, or min_linear_vel to 0"
        )
    if ends:
        raise OptimumError(
            "the robot stops at the end of the path within half as long again as the horizon, "
            "after which the optimum is not defined: give a shorter horizon, or set "
            "max_linear_decel to .inf"
        )


def _windings(start: FloatArray) -> list[FloatArray]:
    """Return a start [s, y, theta], shape (3,), with each theta from which it is worth turning."""
    theta = float(start[2])
    if abs(theta) > math.pi:
        theta = float(wrap_angle(theta))
    turns = [theta]
    if abs(theta) > 0.5 * math.pi:
        turns.append(theta - math.copysign(2.0 * math.pi, theta))
    return [np.array([start[0], start[1], turn]) for turn in turns]


def motions_of(runs: Trajectories | None, known: np.ndarray) -> list[list[Motion]]:
    """Return the motion from each of N starts as a guess for the optimum; none of one that is lost.

    `runs` are recorded from the starts that are `known` (N,). The heading error ends within half a
    turn of 0.
    """
    assert runs is not None  # simulated with record=True
    found: list[list[Motion]] = [[] for _ in known]
    of_each = zip(runs.error, runs.arc_length, runs.modified_input, strict=True)
    for start, (error, place, inputs) in zip(np.flatnonzero(known), of_each, strict=True):
        state = np.column_stack([error, place])
        if np.isfinite(state).all() and np.isfinite(inputs).all():
            heading = np.unwrap(error[:, 2])
            state[:, 2] = heading - 2.0 * math.pi * round(heading[-1] / (2.0 * math.pi))
            found[start].append(Motion(math.inf, runs.time, state, inputs))
    return found
