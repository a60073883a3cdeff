"""The policy far from the path, where nothing is learned."""

import dataclasses
import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.dynamic_programming import State
from adp_path_follower.core.control.fallback import RiccatiPolicy
from adp_path_follower.core.control.policy import descending_input, saturate
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.control.value_grid import DistantValue, ValueGrid
from adp_path_follower.core.control.value_iteration import HEADINGS, ValueProblem
from adp_path_follower.core.control.value_store import problem_of, stored, value_grid
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import (
    FloatArray,
    advance_pose,
    anywhere,
    clamped,
    components,
    cos,
    hypot,
    number,
    numbers,
    sin,
    tracking_error,
    where,
    wrap_angle,
)
from adp_path_follower.core.path.route import turned_settings
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.learning import OWN_FAR_POLICIES, WIDE_REGIONS
from adp_path_follower.core.settings.schema import build


class FarPolicy(Protocol):
    """A policy of a user's own for places far from the path."""

    def modified_input(
        self, zeta: FloatArray, curvature: FloatArray, feedforward: FloatArray
    ) -> FloatArray:
        """Return u = [v_e, w_e], shape (..., 2); the limits are applied to it afterwards.

        States zeta = [s, y, theta, phi] have shape (..., 4), the curvature kappa at the target
        [1/m] (...), the feedforward [v_ss, w_ss], to which u is added, (..., 2).
        """


def register_far_policy(name: str, factory: Callable[[Settings], FarPolicy]) -> None:
    """Register a policy far from the path, so that `wide_region: NAME` chooses it.

    Example: `adp.register_far_policy("turn_first", TurnFirst)`, where `TurnFirst(settings)` has a
    method `modified_input(zeta, curvature, feedforward)`.

    Args:
        name: Letters, digits and _.
        factory: Makes the policy of the settings; its class will do.

    Raises:
        AdpError: The method is missing, or returns something of another shape; or the name is
            taken by the package.

    """
    policy = factory(build(Settings, {}))
    if not hasattr(policy, "modified_input"):
        raise AdpError(f"far policy '{name}' has no 'modified_input(zeta, curvature, feedforward)'")
    for leading in ((), (5,)):
        zeta = np.full((*leading, 4), 0.5)
        feedforward = np.full((*leading, 2), 0.5)
        found = np.asarray(policy.modified_input(zeta, np.full(leading, 0.1), feedforward))
        if found.shape != (*leading, 2) or not np.isfinite(found.astype(float)).all():
            raise AdpError(
                f"far policy '{name}' returns shape {found.shape} for states of shape "
                f"{zeta.shape}, but must return finite numbers of shape {(*leading, 2)}"
            )
    OWN_FAR_POLICIES.register(name, factory)


# [m] between which the value at the best heading takes over: the nodes are too rare there. Less
# below 0.5 m/s, and more above 2 m/s, by the root of `ValueProblem.length_scale`.
_GRID_ENDS = (6.0, 8.0)
_STEERING = 3.0  # [1/s] of the error to the best heading there; more would amplify noise
# [rad] from facing backwards, within which the slope by theta is taken over as much to both sides:
# the heading of the half-angle form has a kink there, in whose notch robots would stay for ever.
_NOTCH = 0.25
_SPACING = 2.0 * math.pi / len(HEADINGS)  # [rad]
_COUNT = np.arange(len(HEADINGS))
_BESIDE = np.array([-1, 0, 1])
# The coming bend is that of the piece of path which k1 adds in so many [s], for a distance ahead
# and so much of that aside; of so many [m] at most. Robots of less than so much of the usual length
# scale wait for their target: all that they are ahead counts, of 1 m at most. They turn while bends
# come, by so many [m/rad].
_COMING_TIME, _ASIDE, _MOST_COMING = 3.0, 0.3, 3.0
_WAITING, _TURNING = 0.7, 0.3
_PLACES = np.linspace(0.0, 1.0, 9)  # on it, as shares, and their weights in the mean
_WEIGHTS = np.array([0.5, *[1.0] * 7, 0.5]) / 8.0
# Share of `wide_region_levels`: the grid is exact where the learned policy is not yet. Less on slow
# robots, by the length scale.
_GRID_LEVELS = 0.7


def missing_values(settings: Settings) -> list[ValueProblem]:
    """Return the value functions that settings need and that nobody has found yet."""
    if settings.policy.wide_region != "value_grid":
        return []
    problems = [problem_of(settings)]
    if settings.path.allow_reversing and settings.limits.min_linear_vel < 0.0:
        problems.append(problem_of(turned_settings(settings)))
    return [problem for problem in problems if stored(problem) is None]


def without_values(settings: Settings) -> Settings:
    """Return the settings to drive with until values are found, which takes no control step."""
    policy = dataclasses.replace(settings.policy, wide_region="approach")
    return dataclasses.replace(settings, policy=policy)


class GridPolicy:
    """The policy of the value function on a grid, which is found when the first robot needs it."""

    def __init__(self, settings: Settings) -> None:
        self._settings, self._problem = settings, problem_of(settings)
        self._grid = stored(self._problem)
        self._inverse = settings.cost.inverse_input_cost()
        self._root = math.sqrt(self._problem.length_scale)

    def modified_input(
        self, zeta: FloatArray, curvature: FloatArray, feedforward: FloatArray
    ) -> FloatArray:
        """Return u = -1/2 R^-1 g^T V_e within the limits, shape (..., 2)."""
        if self._grid is None:
            self._grid = value_grid(self._settings)
        error, limits = zeta[..., :3], self._settings.limits
        s, y, _ = numbers(error)
        start, end = (self._root * distance for distance in _GRID_ENDS)
        beyond = clamped((hypot(s, y) - start) / (end - start), 0.0, 1.0)
        u: FloatArray | None = None
        if anywhere(beyond < 1.0):
            wanted = descending_input(self._descent(self._grid, error, curvature), self._inverse)
            u = saturate(wanted, feedforward, limits)
        if u is not None and not anywhere(beyond > 0.0):
            return u
        wanted = self._distant_input(self._grid.distant, error, curvature, feedforward)
        far = saturate(wanted, feedforward, limits)
        return far if u is None else u + np.asarray(beyond)[..., None] * (far - u)

    def _descent(self, grid: ValueGrid, error: FloatArray, curvature: FloatArray) -> FloatArray:
        """Return g^T V_e at errors (..., 3), shape (..., 2)."""
        s, y, theta = numbers(error)
        value, slope = grid.value_and_slope(error, curvature)
        by_s, by_y, by_theta = numbers(slope)
        backwards = abs(theta) > math.pi - _NOTCH
        if anywhere(backwards):
            left, right = (
                grid.value_and_slope(components(s, y, wrap_angle(theta + angle)), curvature)[0]
                for angle in (_NOTCH, -_NOTCH)
            )
            notch = backwards & ((left > value) != (right > value))
            by_theta = where(notch, 0.5 * (left - right) / _NOTCH, by_theta)
        return components(cos(theta) * by_s + sin(theta) * by_y, by_theta)

    def _distant_input(
        self,
        value: DistantValue,
        error: FloatArray,
        curvature: FloatArray,
        feedforward: FloatArray,
    ) -> FloatArray:
        """Return the input that turns to the best heading, shape (..., 2).

        To the side on which less is lost on the way: the Hamiltonian's excess over the least one,
        summed over the headings in between, is the value of a robot that only turns.
        """
        (_, _, theta), (v_ss, w_ss) = numbers(error), numbers(feedforward)
        kappa = clamped(number(curvature), -value.curvatures[-1], value.curvatures[-1])
        place, limits, count = error[..., :2], self._settings.limits, len(HEADINGS)
        slope = value.slope(place, kappa)
        bounds = limits.lower[0] - v_ss, limits.upper[0] - v_ss
        _, loss = self._problem.headings(place, kappa, slope, *bounds)
        best = loss.argmin(axis=-1)
        at = (best[..., None] + _BESIDE) % count
        beside = loss[at] if loss.ndim == 1 else np.take_along_axis(loss, at, -1)
        before, least, after = numbers(beside)
        between = 0.5 * (before - after) / np.maximum(before + after - 2.0 * least, 1e-9)
        ahead = (theta - HEADINGS[0] - (best + between) * _SPACING) % (2.0 * math.pi)
        excess = loss - np.asarray(least)[..., None]
        # From the best heading on, round to it again.
        on_the_way = (_COUNT - best[..., None]) % count * _SPACING < np.asarray(ahead)[..., None]
        left, whole = (excess * on_the_way).sum(-1), excess.sum(-1)
        off = where(2.0 * left < whole, ahead, ahead - 2.0 * math.pi)
        by_s, by_y = numbers(slope)
        pull = cos(theta) * by_s + sin(theta) * by_y
        return components(-0.5 * self._inverse[0, 0] * pull, -_STEERING * off - w_ss)


class ApproachPolicy:
    """The Riccati law whose lateral part saturates into an approach angle.

    Its steering, -(P_yθ y + P_θθ θ) / R near the path, steers towards the heading
    -P_yθ y / P_θθ; limiting that heading below a right angle leaves no place from which a
    robot that cannot reverse would wait for ever. Its speed counts what a speed does at this
    heading, (cos θ, sin θ): far off course, more speed drives away from the target.
    """

    def __init__(self, settings: Settings, riccati: RiccatiSchedule) -> None:
        self._settings, self._riccati = settings, riccati
        self._inverse = settings.cost.inverse_input_cost()

    def modified_input(
        self, zeta: FloatArray, curvature: FloatArray, feedforward: FloatArray
    ) -> FloatArray:
        """Return u within the limits, shape (..., 2)."""
        matrix = self._riccati.matrix(curvature, feedforward[..., 0])
        s, y, theta = (zeta[..., axis] for axis in range(3))
        widest = self._settings.policy.approach_angle
        slope = matrix[..., 1, 2] / matrix[..., 2, 2]
        off_course = wrap_angle(theta + widest * np.tanh(slope * y / widest))
        ahead, aside = matrix[..., 0, 0] * s, matrix[..., 1, 1] * y
        pull = components(
            ahead * np.cos(theta) + aside * np.sin(theta), matrix[..., 2, 2] * off_course
        )
        return saturate(-pull @ self._inverse, feedforward, self._settings.limits)


class WideRegion:
    """A policy that takes over from the learned one outside the region of the samples."""

    def __init__(self, settings: Settings, riccati: RiccatiSchedule) -> None:
        """Take levels, limits and kind from the settings."""
        self._settings, self._riccati = settings, riccati
        self._kind = settings.policy.wide_region
        # Errors, in half-widths of the samples, between which the policy changes.
        self._levels = settings.policy.wide_region_levels
        self._near, self._reach = RiccatiPolicy(settings, riccati), 0.0
        self._half_widths: list[float] = settings.half_widths.tolist()
        if self._kind == "value_grid":
            start, end = self._levels
            length_scale = problem_of(settings).length_scale
            scale, self._reach = min(1.0, length_scale), math.sqrt(length_scale) * _GRID_ENDS[0]
            share = min(_GRID_LEVELS, scale)
            self._levels = share * start, share * end
            ends = (1.0, _COMING_TIME * settings.target.target_gain), (1.0, _MOST_COMING)
            self._ahead, self._most_coming = (
                float(np.interp(scale, (_WAITING, 1.0), end)) for end in ends
            )
            self._turning = _TURNING * (1.0 - scale)
            self._half_widths[:2] = [scale * width for width in self._half_widths[:2]]
        self._is_own = self._kind not in WIDE_REGIONS
        make = OWN_FAR_POLICIES.find(self._kind) if self._is_own else None
        self._far: FarPolicy
        if make is not None:
            self._far = make(settings)
        elif self._kind == "value_grid":
            self._far = GridPolicy(settings)
        elif self._kind == "approach":
            self._far = ApproachPolicy(settings, riccati)
        else:
            self._far = RiccatiPolicy(settings, riccati)

    @property
    def knows_circles(self) -> bool:
        """Return whether its policy takes the path that comes for a circle."""
        return self._kind == "value_grid"

    def seen(self, zeta: FloatArray, arc_length: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the robot's states and the curvature [1/m] that the far policy is to count.

        The value on a grid knows circles only. That of a robot away from its target is the circle
        with the mean curvature, and the end, of the piece of path that comes until it is there.

        Args:
            zeta: States [s, y, theta, phi], shape (..., 4).
            arc_length: Places of the target [m], shape (...).

        """
        s, y, theta, phi = numbers(zeta)
        ahead = clamped(self._ahead * (s + _ASIDE * abs(y)), 0.0, self._most_coming)
        turning = self._turning * abs(theta)
        covered = where(turning > ahead, turning, ahead)
        places = np.asarray(arc_length)[..., None] + np.asarray(covered)[..., None] * _PLACES
        frames = self._riccati.path.frame(places)
        curvature = frames.curvature @ _WEIGHTS
        end = tracking_error(frames.pose[..., -1, :], frames.pose[..., 0, :])
        begin = advance_pose(end, -covered, -covered * curvature, 1.0)
        return components(*numbers(tracking_error(zeta[..., :3], begin)), phi), curvature

    def reaches(self, state: State) -> bool:
        """Return whether the grid's slopes drive at s and y [m]."""
        return math.hypot(state[0], state[1]) < self._reach

    def is_near(self, state: State) -> bool:
        """Return whether a state is within the region of the samples."""
        s, y, theta, _ = state
        error = np.array([s, y, wrap_angle(theta)])
        return bool((abs(error) < self._settings.half_widths).all())

    def driven_input(self, state: State) -> FloatArray:
        """Return u (2,) of the far policy at a state, and of the Riccati policy near the path."""
        s, y, theta, place = state
        arc_length = np.asarray(place)[()]
        curvature = self._riccati.path.curvature(arc_length)
        v_des = self._riccati.profile.model_speed(arc_length)
        zeta = np.array([s, y, wrap_angle(theta), 0.0])
        there = zeta, curvature, error_dynamics.feedforward(curvature, v_des)
        share = self.share(zeta)
        near = self._near.modified_input(*there) if share < 1.0 else np.zeros(2)
        if not share > 0.0:
            return near
        far = self.far_input(arc_length, *there)
        return np.asarray((1.0 - share) * near + share * far)

    def far_input(
        self,
        arc_length: FloatArray,
        zeta: FloatArray,
        curvature: FloatArray,
        feedforward: FloatArray,
    ) -> FloatArray:
        """Return the far policy's modified input (..., 2) for targets at arc lengths [m] (...).

        The rest is as in `FarPolicy.modified_input`.
        """
        if self._kind == "value_grid":
            zeta, curvature = self.seen(zeta, arc_length)
        far = np.asarray(self._far.modified_input(zeta, curvature, feedforward))
        return saturate(far, feedforward, self._settings.limits) if self._is_own else far

    def share(self, error: FloatArray) -> FloatArray:
        """Return how much of the far policy drives at errors (..., 3 or 4), from 0 to 1, (...)."""
        if self._kind == "none":
            return np.zeros(error.shape[:-1])
        start, end = self._levels
        sizes = [
            abs(value) / width
            for value, width in zip(numbers(error)[:3], self._half_widths, strict=True)
        ]
        level = max(sizes) if error.ndim == 1 else np.maximum.reduce(sizes)
        share: FloatArray = clamped((level - start) / (end - start), 0.0, 1.0)
        return share * share * (3.0 - 2.0 * share)
