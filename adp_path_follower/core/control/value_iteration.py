"""Value iteration: the values of `value_grid`, from settings alone.

    V(e) <- min_u  integral of r over h + V(e(h)),   u constant over the step h,

for each layer of curvature, with the motion of equation (1), the running cost r, and the spline
between nodes (semi-Lagrangian). Inputs that are tried: -1/2 R^-1 g^T V_e within the limits, that of
the last sweep, the sharpest turns, and at first some from limit to limit. Far away, where the
heading may be any at once, W(s, y) is found in the same way, by straight motion.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.basis import Numbers
from adp_path_follower.core.control.riccati import riccati_solutions
from adp_path_follower.core.control.value_grid import (
    DistantValue,
    GridAxes,
    PolarAxes,
    ValueGrid,
    half_angle_form,
)
from adp_path_follower.core.control.virtual_target import MOST_LEAD
from adp_path_follower.core.geometry import FloatArray, last_axis_sum, numbers, unpacked, wrap_angle
from adp_path_follower.core.settings.groups import (
    FAST,
    CostSettings,
    LimitSettings,
    TargetSettings,
)

_CURVATURES = np.array([0.0, 0.25, 0.6, 0.9, 1.2, 2.0])  # [1/m] of the layers
# [m], times the root of the length scale: the largest |s| and |y|, as values are used within half
# of it, and the distance within which they must have settled.
_REACH, _COUNTED = 16.0, 10.0
_COARSE, _FINE = (19, 19, 20), (35, 35, 28)
_STEP = 0.15  # [s] of a sweep, or less at speeds at which a step would cross ...
_SLOWEST = 0.4  # of the usual speed: robots below that have longer steps by the root, down to this
_STRIDE = 0.25  # [m], more on fast robots: in shorter steps the values would settle too early
_FAR = 4.0  # [m] from which on steps grow with the distance, as the spacing of the nodes does
_TURN = 0.3  # [rad] of the target's frame in a step
_NEAR = 0.3  # [m], [rad] about the path, where the Riccati solution is the value, ...
_BEND = 2.0  # [m] within which the nodes are about equally spaced, ...
_USUAL_SPEED = 0.5  # [m/s] along the path: slower robots change their ways within shorter lengths
_POLICY_EVERY = 5  # sweeps from one policy to the next
_COARSE_SWEEPS = 60
_SEARCHED = 30  # sweeps of the first grid that try inputs from limit to limit, too
_SETTLED = 5e-5  # mean change of rho in a sweep
_MOST_SWEEPS = 400
_UNLIMITED = 2.0  # speeds where there is no limit, as multiples of v_des + 1/s of the distance
_MOST_TURN = 0.3  # [rad] of a step where there is no limit; with 1.0 steep costs left robots aside
_DISTANT, _ENDS = (40, 72), (5.0, 100.0)  # nodes, and [m] between them, of W
_DISTANT_LAYERS = 2  # a sharper bend moves the target hardly more, beside such a distance
_STEEP = 3.0  # root of W by the distance to begin with
HEADINGS = np.linspace(-math.pi, math.pi, 73)[:-1]  # [rad] that are compared far away
_COS, _SIN = np.cos(HEADINGS), np.sin(HEADINGS)
METHOD = (10, tuple(_CURVATURES.tolist()), _REACH, _FINE)  # another one finds other values


@dataclass(frozen=True)
class ValueProblem:
    """Target, cost and limits: the settings that the value function depends on."""

    target: TargetSettings
    cost: CostSettings
    limits: LimitSettings

    @property
    def speed(self) -> float:
        """Return the speed along the path that the robot can drive [m/s]."""
        return min(self.target.desired_speed, float(self.limits.upper[0]))

    @property
    def fastest(self) -> float:
        """Return the highest speed of the virtual target [m/s]."""
        return self.target.desired_speed + self.target.target_gain * MOST_LEAD

    @property
    def length_scale(self) -> float:
        """Return the length within which the best way changes, as a share of the usual one."""
        return min(1.0, self.speed / _USUAL_SPEED) * max(1.0, self.speed / FAST)

    def headings(
        self,
        place: FloatArray,
        curvature: FloatArray | float,
        slope: FloatArray,
        low: FloatArray,
        high: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the best v_e at all HEADINGS (..., N), and the Hamiltonian less s^2 and y^2.

        W has its slope (..., 2) at the place [s, y] (..., 2); v_e is between low and high (...).
        """
        (_, _, c_st), (_, _, c_yt), (_, _, c_tt) = self._state_cost
        s, y, by_s, by_y, kappa, least, most = (
            np.asarray(values)[..., None]
            for values in (*numbers(place), *numbers(slope), curvature, low, high)
        )
        descent = by_s * _COS + by_y * _SIN
        v = np.minimum(np.maximum(-0.5 / self._effort * descent, least), most)
        passing = self.speed * _COS + self.target.target_gain * s
        passing = np.minimum(np.maximum(passing, -self.fastest), self.fastest)
        drift = self.speed * descent - passing * (by_s * (1.0 - kappa * y) + by_y * kappa * s)
        turned = HEADINGS * (c_tt * HEADINGS + 2.0 * (c_st * s + c_yt * y))
        return v, turned + drift + v * (self._effort * v + descent)

    @functools.cached_property
    def _state_cost(self) -> list[list[float]]:
        rows: list[list[float]] = self.cost.state_cost_matrix().tolist()
        return rows  # kept, as each control step far away asks for it

    @functools.cached_property
    def _effort(self) -> float:
        return float(self.cost.input_cost_matrix()[0, 0])


def solve(problem: ValueProblem) -> ValueGrid:
    """Return the value function of a problem."""
    bend = _BEND * problem.length_scale
    root = math.sqrt(problem.length_scale)
    coarse, fine = (GridAxes(shape, root * _REACH, bend) for shape in (_COARSE, _FINE))
    far = PolarAxes(_DISTANT, *(root * end for end in _ENDS))
    count = len(_CURVATURES)
    riccati = riccati_solutions(
        _CURVATURES, np.full(count, problem.speed), problem.target, problem.cost
    )
    start = _Layer(problem, coarse, 0.0, riccati[0])
    coefficients = start.iterate(_filtered(np.full(_COARSE, 1.2)), _COARSE_SWEEPS, _SEARCHED)
    axes, layers, distant = coarse, [], []
    for number, curvature in enumerate(_CURVATURES):
        layer = _Layer(problem, fine, float(curvature), riccati[number])
        guess = _interpolated(coefficients, axes.position(*unpacked(fine.nodes))[0])
        coefficients = layer.iterate(_filtered(guess), _MOST_SWEEPS)
        if curvature == 0.0:  # left and right are alike; neither is to be preferred
            ratio = _at_nodes(coefficients)
            mirrored = ratio[:, ::-1, -np.arange(_FINE[2])]
            coefficients = _filtered(np.minimum(ratio, mirrored))
        axes = fine
        layers.append(coefficients)
        if number < _DISTANT_LAYERS:
            outer = _Distant(problem, far, float(curvature))
            distant.append(outer.values(functools.partial(layer.value, coefficients)))
    beyond = DistantValue(far, _CURVATURES[:_DISTANT_LAYERS], np.stack(distant))
    return ValueGrid(fine, _CURVATURES, riccati, np.stack(layers), beyond)


class _Nodes:
    """The problem at one curvature, and motion from the nodes of a grid."""

    def __init__(self, problem: ValueProblem, nodes: FloatArray, curvature: float) -> None:
        self._curvature = curvature
        target, limits = problem.target, problem.limits
        self._speed, self._fastest = problem.speed, problem.fastest
        self._gain = target.target_gain
        self._state_cost = problem.cost.state_cost_matrix()
        self._input_cost = problem.cost.input_cost_matrix()
        forward = np.array([self._speed, curvature * self._speed])
        self._nodes = nodes
        self._distance = np.hypot(self._nodes[..., 0], self._nodes[..., 1])
        self._stride = _STRIDE * max(1.0, problem.length_scale)
        self._step = self._steps(self._distance, max(limits.upper[0], -limits.lower[0]))
        # Where there is no limit, as much as a step can follow.
        driven = _UNLIMITED * (self._speed + self._distance)
        most = np.stack([driven, _MOST_TURN / self._step], axis=-1)
        self._low = np.where(np.isfinite(limits.lower), limits.lower, -most) - forward
        self._high = np.where(np.isfinite(limits.upper), limits.upper, most) - forward

    def _steps(self, distance: FloatArray, fastest: float) -> FloatArray:
        """Return the time of a step [s] at the nodes: longer where these are further apart."""
        growth = np.maximum(1.0, distance / _FAR)
        driven = self._speed + np.minimum(fastest, self._speed + distance)
        turned = abs(self._curvature) * (self._speed + self._gain * np.abs(self._nodes[..., 0]))
        usual = _STEP / math.sqrt(min(max(fastest / _USUAL_SPEED, _SLOWEST), 1.0))
        wide = np.maximum(usual, _TURN / np.maximum(turned, 1e-9))
        steps = np.minimum(np.minimum(usual * growth, wide), self._stride * growth / driven)
        return np.asarray(steps)

    def _moved(self, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the errors a step later, and the cost on the way by Simpson's rule."""
        half = self._after(self._nodes, u, 0.5 * self._step)
        after = self._after(half, u, self._step)
        costs = self._cost(self._nodes) + 4.0 * self._cost(half) + self._cost(after)
        effort = last_axis_sum((u @ self._input_cost) * u)
        return after, self._step * (costs / 6.0 + effort)

    def _after(self, middle: FloatArray, u: FloatArray, time: FloatArray) -> FloatArray:
        """Return the errors after a time [s]: robot and target on arcs, s_p' as at `middle`."""
        error = self._nodes
        s, y, theta = error[..., 0], error[..., 1], error[..., 2]
        target = self._speed * np.cos(middle[..., 2]) + self._gain * middle[..., 0]
        covered = np.clip(target, -self._fastest, self._fastest) * time
        turned = self._curvature * covered
        turn = (self._curvature * self._speed + u[..., 1]) * time
        ahead, aside = _chord((self._speed + u[..., 0]) * time, turn)
        path_ahead, path_aside = _chord(covered, turned)
        cos, sin = np.cos(theta), np.sin(theta)
        x = s + cos * ahead - sin * aside - path_ahead
        z = y + sin * ahead + cos * aside - path_aside
        cos, sin = np.cos(turned), np.sin(turned)
        return np.stack([cos * x + sin * z, cos * z - sin * x, theta + turn - turned], axis=-1)

    def _cost(self, error: FloatArray) -> FloatArray:
        wrapped = np.concatenate([error[..., :2], wrap_angle(error[..., 2:])], axis=-1)
        return last_axis_sum((wrapped @ self._state_cost) * wrapped)


class _Layer(_Nodes):
    """The value function near the path at one curvature."""

    def __init__(
        self, problem: ValueProblem, axes: GridAxes, curvature: float, riccati: FloatArray
    ) -> None:
        super().__init__(problem, axes.nodes, curvature)
        self._axes, self._riccati = axes, riccati
        base, slope = half_angle_form(unpacked(self._nodes), riccati)
        self._base_slope = np.stack(slope, axis=-1)
        self._base = np.maximum(base, 1e-9)
        self._counted = self._distance < _COUNTED * math.sqrt(problem.length_scale)
        scale = problem.length_scale
        self._near = (np.abs(self._nodes) < _NEAR * np.array([scale, scale, 1.0])).all(-1)

    def iterate(self, coefficients: FloatArray, sweeps: int, searched: int = 0) -> FloatArray:
        """Return the coefficients when sweeps change rho no more."""
        ratio, way = _at_nodes(coefficients), self._way(np.clip(0.0, self._low, self._high))
        for sweep in range(sweeps):
            values = _onwards(way, coefficients)
            if sweep % _POLICY_EVERY == 0:
                for u in self._inputs(sweep, searched, ratio, coefficients):
                    other = self._way(u)
                    found = _onwards(other, coefficients)
                    way = np.where(found < values, other, way)
                    values = np.minimum(found, values)
            found = np.where(self._near, 1.0, np.sqrt(np.maximum(values, 0.0) / self._base))
            change = float(np.abs(found - ratio)[self._counted].mean())
            ratio, coefficients = found, _filtered(found)
            if change < _SETTLED and sweep >= searched:
                break
        return coefficients

    def value(self, coefficients: FloatArray, error: FloatArray) -> FloatArray:
        """Return V of coefficients at errors (..., 3), shape (...)."""
        return _onwards(self._ended(error, np.zeros(error.shape[:-1])), coefficients)

    def _way(self, u: FloatArray) -> FloatArray:
        """Return where a step with inputs (..., 2) leads from the nodes, as `_onwards` takes it."""
        return self._ended(*self._moved(u))

    def _ended(self, error: FloatArray, cost: FloatArray) -> FloatArray:
        """Return a step's cost (...), and form and place of the error (..., 3) at its end."""
        s, y, theta = unpacked(error)
        place, _ = self._axes.position(s, y, theta)
        form, _ = half_angle_form((s, y, wrap_angle(theta)), self._riccati)
        return np.stack([cost, np.maximum(form, 1e-9), *place])

    def _inputs(
        self, sweep: int, searched: int, ratio: FloatArray, coefficients: FloatArray
    ) -> Iterator[FloatArray]:
        """Return inputs at the nodes that may be better than the last ones, (..., 2) each."""
        wanted = self._descending(ratio, coefficients)
        yield wanted
        if sweep < searched:
            yield from self._trials()
        elif sweep % (2 * _POLICY_EVERY) == 0:
            # Between two ways slopes may keep a robot where it is, and its value grows for ever.
            side = self._low if sweep % (4 * _POLICY_EVERY) else self._high
            yield np.stack([wanted[..., 0], side[..., 1]], axis=-1)

    def _trials(self) -> list[FloatArray]:
        """Return inputs from limit to limit at the nodes, (..., 2) each."""
        shares = itertools.product(np.linspace(0.0, 1.0, 4), np.linspace(0.0, 1.0, 5))
        return [self._low + share * (self._high - self._low) for share in map(np.array, shares)]

    def _descending(self, ratio: FloatArray, coefficients: FloatArray) -> FloatArray:
        """Return u = -1/2 R^-1 g^T V_e within the limits at the nodes, (..., 2)."""
        slope = self._base_slope * (ratio**2)[..., None]
        _, stretch = self._axes.position(*unpacked(self._nodes))
        for axis in range(3):
            by_node = _at_nodes(coefficients, axis)
            slope[..., axis] += 2.0 * ratio * self._base * by_node * stretch[axis]
        theta = self._nodes[..., 2]
        ahead = np.cos(theta) * slope[..., 0] + np.sin(theta) * slope[..., 1]
        descent = np.stack([ahead, slope[..., 2]], axis=-1)
        wanted = -0.5 * descent @ np.linalg.inv(self._input_cost)
        return np.clip(wanted, self._low, self._high)


class _Distant(_Nodes):
    """The problem at one curvature far from the path, with headings that may be any at once."""

    def __init__(self, problem: ValueProblem, axes: PolarAxes, curvature: float) -> None:
        super().__init__(problem, axes.nodes, curvature)
        self._problem, self._axes = problem, axes

    def values(self, within: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Return the coefficients, with the value `within` of errors (N, 3) nearer to the path."""
        ratio = np.full(self._distance.shape, _STEEP)
        kept = self._courses(ratio)
        for sweep in range(_MOST_SWEEPS):
            if sweep % _POLICY_EVERY == 0:
                tried = self._courses(ratio)
                now, before = (
                    self._after_a_step(*self._ways(courses, within), ratio)
                    for courses in (tried, kept)
                )
                kept = np.where((now < before)[..., None], tried, kept)
                way = self._ways(kept, within)
            found = np.sqrt(self._after_a_step(*way, ratio)) / self._distance
            change = float(np.abs(found - ratio).mean())
            ratio = found
            if change < _SETTLED and sweep > _POLICY_EVERY:
                break
        return _filtered(ratio)

    def _courses(self, ratio: FloatArray) -> FloatArray:
        """Return the best heading and v_e by the slope of W at the nodes, (..., 2)."""
        coefficients = _filtered(ratio)
        place, layers = self._nodes[..., :2], np.stack([coefficients, coefficients])
        value = DistantValue(self._axes, np.array([0.0, 1.0]), layers)
        slope = value.slope(place, np.zeros(place.shape[:-1]))
        limits = self._low[..., 0], self._high[..., 0]
        v, hamiltonian = self._problem.headings(place, self._curvature, slope, *limits)
        best = hamiltonian.argmin(axis=-1)
        return np.stack([HEADINGS[best], np.take_along_axis(v, best[..., None], -1)[..., 0]], -1)

    def _ways(
        self, courses: FloatArray, within: Callable[[FloatArray], FloatArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return cost, places a step later [nodes], and distances there, 0 if within the nodes."""
        self._nodes[..., 2] = courses[..., 0]
        straight = np.full(courses.shape[:-1], -self._curvature * self._speed)
        after, cost = self._moved(np.stack([courses[..., 1], straight], axis=-1))
        distance = np.hypot(after[..., 0], after[..., 1])
        inside = distance < self._axes.start
        cost[inside] += within(after[inside])
        place = np.stack(self._axes.position(after[..., 0], after[..., 1]))
        return cost, place, np.where(inside, 0.0, distance)

    @staticmethod
    def _after_a_step(
        cost: FloatArray, place: FloatArray, distance: FloatArray, ratio: FloatArray
    ) -> FloatArray:
        """Return W by linear interpolation: splines overshoot, and once grew without bound."""
        from scipy.ndimage import map_coordinates

        around = np.concatenate([ratio, ratio[:, :1]], axis=1)
        onwards = distance * map_coordinates(around, place, order=1, mode="nearest")
        return np.asarray(cost + onwards**2)


def _chord(length: FloatArray, turn: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far an arc leads ahead and to the left of its beginning."""
    half = 0.5 * turn + 1e-12  # the arc of no turn is straight
    sin = np.sin(half)
    straight = length * sin / half
    return straight * np.cos(half), straight * sin


def _filtered(ratio: FloatArray) -> FloatArray:
    """Return the padded spline coefficients of values at the nodes; the last axis is periodic."""
    from scipy.ndimage import spline_filter1d

    found, last = ratio, ratio.ndim - 1
    for axis in range(last):
        found = spline_filter1d(found, 3, axis, mode="mirror")
    found = spline_filter1d(found, 3, last, mode="grid-wrap")
    found = np.pad(found, [*[(1, 1)] * last, (0, 0)], mode="reflect")
    return np.concatenate([found[..., -1:], found, found[..., :2]], axis=-1)


def _interpolated(coefficients: FloatArray, place: FloatArray | Numbers) -> FloatArray:
    """Return rho at places (3, ...) [nodes]."""
    from scipy.ndimage import map_coordinates

    place = np.asarray(place) + 1.0
    found = map_coordinates(coefficients, place, order=3, prefilter=False, mode="nearest")
    return np.asarray(found)


def _onwards(way: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Return the cost of a step and of all that comes, by cost, form and place [nodes] (5, ...)."""
    return np.asarray(way[0] + way[1] * _interpolated(coefficients, way[2:]) ** 2)


def _at_nodes(coefficients: FloatArray, slope: int | None = None) -> FloatArray:
    """Return rho at the nodes, or its derivative along an axis [1/node]."""
    found = coefficients
    for axis in range(3):
        count = coefficients.shape[axis] - (2 if axis < 2 else 3)
        before, here, after = (np.take(found, range(k, k + count), axis) for k in range(3))
        found = 0.5 * (after - before) if axis == slope else (before + 4.0 * here + after) / 6.0
    return found
