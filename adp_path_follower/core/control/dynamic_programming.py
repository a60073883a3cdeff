"""Differential dynamic programming: the best inputs about a motion along the path as it is.

The value V about a motion x_k, x = [s, y, theta, s_p], is quadratic, from its end back

    V_k(x) = min_u  r h + V_{k+1}(x'),   x' from x by equation (1) with u held over a step h,

with the second derivatives of the motion, too (Jacobson, Mayne 1970), and inputs within the limits
(Tassa, Mansard, Todorov 2014). The minimiser is u_k plus gains by x - x_k.
"""

import bisect
import itertools
import math
from collections.abc import Callable, Generator
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.cost import RunningCost
from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray, Number, cos, sin, wrap_angle
from adp_path_follower.core.settings.groups import Settings

# [s] of a motion's steps: short where it is driven, longer where it is only looked at.
_STEPS = np.geomspace(0.04, 0.5, 40)
_STRIDE = 0.3  # [m] along the path in the longest one; all are shorter on fast robots
_APART = 0.01  # [m] between places whose curvature and speed are compared
# Deviations from a motion within which its gains hold: s and y [m], theta [rad], s_p [m].
_HOLDS = (0.1, 0.1, 0.2, 0.1)

State = tuple[float, float, float, float]  # s [m], y [m], theta [rad], s_p [m]
# From time [s], state, and time [s] for which it is held, to the input u (2,) within the limits.
Policy = Callable[[float, State, float], FloatArray]


@dataclass(frozen=True)
class Motion:
    """A motion of one robot in K steps.

    Attributes:
        times: When each state is reached [s], K + 1 numbers.
        states: x, shape (K + 1, 4).
        inputs: u, each held in a step, shape (K, 2).
        cost: J of the motion, with the Riccati solution's value at its end.

    """

    times: list[float]
    states: FloatArray
    inputs: FloatArray
    cost: float

    @property
    def start(self) -> State:
        """Return the first state."""
        s, y, theta, place = self.states[0].tolist()
        return s, y, theta, place

    @property
    def end(self) -> State:
        """Return the last state."""
        s, y, theta, place = self.states[-1].tolist()
        return s, y, theta, place


class Feedback:
    """Inputs along a motion, and their gains by deviations from it."""

    def __init__(self, motion: Motion, inputs: FloatArray, gains: FloatArray) -> None:
        """Take u_k (K, 2), each of the middle of its step, and its gains (K, 2, 4)."""
        times = motion.times
        self._times, self._inputs = times[:-1], inputs
        self._middles = [0.5 * sum(pair) for pair in itertools.pairwise(times)]
        self._rows = np.concatenate([motion.states[:-1], gains.reshape(-1, 8)], axis=1)

    def holds(self, time: float, state: State) -> bool:
        """Return whether a state at a time [s] is near enough to the motion, which goes on."""
        off = self._deviation(_between(self._rows, self._times, time), state)
        near = all(abs(value) <= most for value, most in zip(off, _HOLDS, strict=True))
        return near and self.reaches(time)

    def reaches(self, time: float) -> bool:
        """Return whether the motion goes on at a time [s]."""
        return time < self._middles[-1]

    def input(self, time: float, state: State, held: float) -> FloatArray:
        """Return u (2,) for a state at a time [s], held for some time [s], without limits."""
        v, w = _between(self._inputs, self._middles, time + 0.5 * held)
        row = _between(self._rows, self._times, time)
        s, y, theta, place = self._deviation(row, state)
        return np.array(
            [
                v + row[4] * s + row[5] * y + row[6] * theta + row[7] * place,
                w + row[8] * s + row[9] * y + row[10] * theta + row[11] * place,
            ]
        )

    @staticmethod
    def _deviation(row: list[float], state: State) -> State:
        s, y, theta, place = state
        return s - row[0], y - row[1], float(wrap_angle(theta - row[2])), place - row[3]


def _between(rows: FloatArray, times: list[float], time: float) -> list[float]:
    """Return a row at a time [s], by those at times next to it."""
    row = min(max(bisect.bisect(times, time) - 1, 0), len(times) - 2)
    part = (time - times[row]) / (times[row + 1] - times[row])
    found: list[float] = (rows[row] + part * (rows[row + 1] - rows[row])).tolist()
    return found


class MotionModel:
    """The error dynamics of one robot on its path, driven ahead in thought.

    Attributes:
        limits: Those of the command.

    """

    def __init__(self, settings: Settings, riccati: RiccatiSchedule) -> None:
        """Take the settings, and path, speeds and the value at the end of a motion."""
        self._riccati, self.limits = riccati, settings.limits
        self._target, self._running_cost = settings.target, RunningCost(settings.cost)
        longest = _STRIDE / settings.target.desired_speed
        self._steps = _STEPS * min(1.0, longest / _STEPS[-1])

    def driven(
        self, policy: Policy, begun: float, state: State, effort: float, most: float = math.inf
    ) -> Generator[float, None, Motion | None]:
        """Return the motion of a policy from a state at a time [s] on.

        Yields the effort after each step. Returns None as soon as J is not below `most`.
        """
        times, states, inputs, cost = [begun], [state], [], 0.0
        for step in self._steps.tolist():
            u = policy(times[-1], state, step)
            middle = self._after(state, state, u, 0.5 * step)
            state = self._after(state, middle, u, step)
            cost += step * float(self._running_cost(_error(middle), u))
            times.append(times[-1] + step)
            states.append(state)
            inputs.append(u)
            yield effort
            if not cost < most:
                return None
        error = _error(state)
        cost += float(error @ self._riccati.matrix(*self._place(state[3])) @ error)
        if not cost < most:
            return None
        return Motion(times, np.array(states), np.array(inputs), cost)

    def improved(
        self, motion: Motion, part: float, effort: float
    ) -> Generator[float, None, Feedback]:
        """Return the best inputs about a motion, or a part of the way to them, with their gains.

        Yields the effort after each step.
        """
        steps, inputs = self._linearised(motion), motion.inputs.copy()
        yield 10.0 * effort  # about as much as ten of those that follow
        gains, rows = np.zeros((len(inputs), 2, 4)), np.eye(6)[:, :4]
        slope, bend = np.zeros(4), np.zeros((4, 4))
        bend[:3, :3] = 2.0 * self._riccati.matrix(*self._place(motion.end[3]))
        slope[:3] = bend[:3, :3] @ _error(motion.end)
        for number in range(len(inputs) - 1, -1, -1):
            changes = steps.changes[number]
            by = steps.slopes[number] + changes.T @ slope
            twice = steps.bends[number] + changes.T @ bend @ changes
            curved = self._curved(slope.tolist(), steps.middles[number].tolist())
            twice += self._steps[number] * curved
            bounds = steps.low[number].tolist(), steps.high[number].tolist()
            u, gains[number] = _best(by[4:].tolist(), twice[4:], *bounds)
            inputs[number] += part * u
            rows[4:] = gains[number]
            slope = rows.T @ (by + twice[:, 4:] @ (part * u))
            bend = rows.T @ twice @ rows
            yield effort
        return Feedback(motion, inputs, gains)

    def limited(self, u: FloatArray, place: float) -> FloatArray:
        """Return an input (2,) within the limits of the command at a place [m]."""
        return saturate(u, error_dynamics.feedforward(*self._place(place)), self.limits)

    def _place(self, place: float) -> tuple[FloatArray, float]:
        """Return curvature [1/m] and v_des [m/s] at a place [m]."""
        speed = self._riccati.profile.model_speed(np.asarray(place)[()])
        return self._riccati.path.curvature(place), float(speed)

    def _after(self, state: State, middle: State, u: FloatArray, time: float) -> State:
        """Return the state after a time [s], with the rates at another state on the way."""
        s, y, theta, place = middle
        by_s, by_y, by_theta, by_place = self._rates((s, y, theta), u.tolist(), *self._place(place))
        return (
            float(state[0] + time * by_s),
            float(state[1] + time * by_y),
            float(state[2] + time * by_theta),
            float(state[3] + time * by_place),
        )

    def _rates(
        self, error: tuple[Number, ...], u: tuple[Number, ...], kappa: FloatArray, v_des: Number
    ) -> tuple[FloatArray, ...]:
        """Return x' for s, y and theta, and u, four numbers of shape (...)."""
        (s, _, theta), (v_e, w_e) = error, u
        along = cos(theta)
        speed = v_des * along + self._target.target_gain * s
        by_s, by_y, by_theta = error_dynamics.error_rates(error, kappa, speed, v_des)
        return by_s + along * v_e, by_y + sin(theta) * v_e, by_theta + w_e, speed

    def _linearised(self, motion: Motion) -> "_Steps":
        """Return the derivatives of all steps, with rates in the middle of each."""
        states, u, step = motion.states[:-1], motion.inputs, self._steps[:, None, None]
        there = self._surroundings(states, u)
        rates = self._rates(tuple(states.T[:3]), tuple(u.T), there.kappa, there.v_des)
        middles = states + 0.5 * step[:, 0] * np.stack(rates, axis=1)
        half = 0.5 * step * self._jacobian(there)
        half[:, :4, :4] += np.eye(4)
        middle = self._surroundings(middles, u)
        jacobian = self._jacobian(middle)
        changes = step * (jacobian[:, :, :4] @ half)
        changes[:, :, :4] += np.eye(4)
        changes[:, :, 4:] += step * jacobian[:, :, 4:]
        errors = np.column_stack([middles[:, :2], wrap_angle(middles[:, 2])])
        pulls = 2.0 * step * half[:, :3].swapaxes(1, 2) @ self._running_cost.state_cost
        slopes, bends = (pulls @ errors[..., None])[..., 0], pulls @ half[:, :3]
        input_costs = 2.0 * step * self._running_cost.input_cost
        slopes[:, 4:] += (input_costs @ u[..., None])[..., 0]
        bends[:, 4:, 4:] += input_costs
        commands = error_dynamics.feedforward(middle.kappa, middle.v_des) + u
        low, high = self.limits.lower - commands, self.limits.upper - commands
        return _Steps(changes, slopes, bends, low, high, np.stack(middle.numbers, axis=1))

    def _surroundings(self, states: FloatArray, u: FloatArray) -> "_Surroundings":
        """Return what derivatives at states (K, 4) with inputs (K, 2) are made of."""
        s, y, theta, places = states.T
        around = places[:, None] + _APART * np.array([-1.0, 0.0, 1.0])
        before, kappa, after = self._riccati.path.curvature(around).T
        profile = self._riccati.profile
        speeds = np.broadcast_to(profile.model_speed(around), around.shape)
        rises = (speeds[:, 2] - speeds[:, 0]) / (2.0 * _APART)
        turns = (after - before) / (2.0 * _APART)
        v_des, v_e = speeds[:, 1], u[:, 0]
        return _Surroundings(s, y, np.cos(theta), np.sin(theta), kappa, turns, v_des, rises, v_e)

    def _jacobian(self, there: "_Surroundings") -> FloatArray:
        """Return the derivatives of x' by x and u, shape (K, 4, 6)."""
        s, y, along, across, kappa, turn, v_des, rise, v_e = there.numbers
        gain, v = self._target.target_gain, v_des + v_e
        speed, by_theta, by_place = v_des * along + gain * s, -v_des * across, rise * along
        ahead = kappa * y - 1.0
        jacobian = np.zeros((len(s), 4, 6))
        jacobian[:, 0, 0] = gain * ahead
        jacobian[:, 0, 1] = kappa * speed
        jacobian[:, 0, 2] = by_theta * ahead - v * across
        jacobian[:, 0, 3] = by_place * ahead + speed * turn * y + rise * along
        jacobian[:, 1, 0] = -kappa * (speed + gain * s)
        jacobian[:, 1, 2] = v * along - kappa * s * by_theta
        jacobian[:, 1, 3] = rise * across - s * (turn * speed + kappa * by_place)
        jacobian[:, 2, 0] = -kappa * gain
        jacobian[:, 2, 2] = -kappa * by_theta
        jacobian[:, 2, 3] = turn * (v_des - speed) + kappa * (rise - by_place)
        jacobian[:, 3, 0] = gain
        jacobian[:, 3, 2] = by_theta
        jacobian[:, 3, 3] = by_place
        jacobian[:, 0, 4], jacobian[:, 1, 4], jacobian[:, 2, 5] = along, across, 1.0
        return jacobian

    def _curved(self, slope: list[float], there: list[float]) -> FloatArray:
        """Return the second derivatives of slope^T x' by x and u, shape (6, 6).

        Less those of curvature and speed by the place twice, which matter little.
        """
        by_s, by_y, by_theta, by_place = slope
        s, y, along, across, kappa, turn, v_des, _, v_e = there
        gain, v = self._target.target_gain, v_des + v_e
        speed, less = v_des * along + gain * s, -v_des * across
        pull = by_s * (kappa * y - 1.0) - by_y * kappa * s - by_theta * kappa + by_place
        bent = turn * (by_s * y - by_y * s - by_theta)
        twice = np.zeros((6, 6))
        twice[0, 0] = -2.0 * gain * by_y * kappa
        twice[0, 1] = twice[1, 0] = gain * by_s * kappa
        twice[0, 2] = twice[2, 0] = -less * by_y * kappa
        twice[0, 3] = twice[3, 0] = gain * bent - speed * turn * by_y
        twice[1, 2] = twice[2, 1] = less * by_s * kappa
        twice[1, 3] = twice[3, 1] = speed * turn * by_s
        twice[2, 2] = -v_des * along * pull - v * (by_s * along + by_y * across)
        twice[2, 3] = twice[3, 2] = less * bent
        twice[2, 4] = twice[4, 2] = by_y * along - by_s * across
        return twice


@dataclass(frozen=True)
class _Surroundings:
    """States and path at K places; each of shape (K,)."""

    s: FloatArray
    y: FloatArray
    along: FloatArray  # cos(theta)
    across: FloatArray  # sin(theta)
    kappa: FloatArray
    turn: FloatArray  # of kappa by s_p
    v_des: FloatArray
    rise: FloatArray  # of v_des by s_p
    v_e: FloatArray

    @property
    def numbers(self) -> tuple[FloatArray, ...]:
        """Return all of them, in this order."""
        return tuple(vars(self).values())


@dataclass(frozen=True)
class _Steps:
    """The derivatives of K steps by [x, u]."""

    changes: FloatArray  # of x', shape (K, 4, 6)
    slopes: FloatArray  # of the cost, shape (K, 6), ...
    bends: FloatArray  # ... and again, shape (K, 6, 6)
    low: FloatArray  # changes of u within the limits, shape (K, 2), ...
    high: FloatArray  # ... at most, shape (K, 2)
    middles: FloatArray  # numbers of `_Surroundings`, shape (K, 9)


def _error(state: tuple[float, ...]) -> FloatArray:
    """Return [s, y, theta] of a state, shape (3,)."""
    return np.array([state[0], state[1], wrap_angle(state[2])])


def _best(
    by: list[float], twice: FloatArray, low: list[float], high: list[float]
) -> tuple[FloatArray, FloatArray]:
    """Return the change of u (2,) with the least cost within bounds, and its gains (2, 4).

    Takes the cost's slope by u (2,) and its second derivatives by u, and x or u, (2, 6).
    """
    (first, second), across = by, twice[:, :4]
    (a, b), (_, d) = twice[:, 4:].tolist()
    whole = a * d - b * b
    if not (a > 0.0 and whole > 0.0):  # nothing is the least, so that the inputs stay
        return np.zeros(2), np.zeros((2, 4))
    v = min(max((b * second - d * first) / whole, low[0]), high[0])
    for _ in range(2):  # one input for the other's, as both may be at their bounds
        wanted_w = -(second + b * v) / d
        w = min(max(wanted_w, low[1]), high[1])
        wanted_v = -(first + b * w) / a
        v = min(max(wanted_v, low[0]), high[0])
    gains = np.zeros((2, 4))
    v_is_free, w_is_free = v == wanted_v, w == wanted_w
    if v_is_free and w_is_free:
        gains[0] = (b * across[1] - d * across[0]) / whole
        gains[1] = (b * across[0] - a * across[1]) / whole
    elif v_is_free:
        gains[0] = across[0] / -a
    elif w_is_free:
        gains[1] = across[1] / -d
    return np.array([v, w]), gains
