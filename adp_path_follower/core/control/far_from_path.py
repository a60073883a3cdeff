"""The policy far from the path, where nothing is learned."""

import dataclasses
import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

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
    components,
    pose_in_frame,
    tracking_error,
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
_GRID_ENDS = np.array([6.0, 8.0])
_STEERING = 3.0  # [1/s] of the error to the best heading there; more would amplify noise
# [rad] from facing backwards, within which the slope by theta is taken over as much to both sides:
# the heading of the half-angle form has a kink there, in whose notch robots would stay for ever.
_NOTCH = 0.25
_SPACING = 2.0 * math.pi / len(HEADINGS)  # [rad]
# The coming bend is that of the piece of path which k1 adds in so many [s], for a distance ahead
# and so much of that aside; of so many [m] at most.
_COMING_TIME, _ASIDE, _MOST_COMING = 3.0, 0.3, 3.0
_PLACES = np.linspace(0.0, 1.0, 9)  # on it, as shares, and their weights in the mean
_WEIGHTS = np.array([0.5, *[1.0] * 7, 0.5]) / 8.0
_CHANGE_TIME = 1.0  # [s] from one policy to another
_GRID_LEVELS = 0.7  # of `wide_region_levels`: the grid is exact where the learned policy is not yet


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
        self._ends = math.sqrt(self._problem.length_scale) * _GRID_ENDS

    def modified_input(
        self, zeta: FloatArray, curvature: FloatArray, feedforward: FloatArray
    ) -> FloatArray:
        """Return u = -1/2 R^-1 g^T V_e within the limits, shape (..., 2)."""
        if self._grid is None:
            self._grid = value_grid(self._settings)
        error, kappa = zeta[..., :3], np.asarray(curvature)
        start, end = self._ends
        distance = np.hypot(error[..., 0], error[..., 1])[..., None]
        beyond = np.clip((distance - start) / (end - start), 0.0, 1.0)
        u = np.zeros((*kappa.shape, 2))
        if (beyond < 1.0).any():
            wanted = descending_input(self._descent(self._grid, error, kappa), self._inverse)
            u = saturate(wanted, feedforward, self._settings.limits)
        if (beyond > 0.0).any():
            wanted = self._distant_input(self._grid.distant, error, kappa, feedforward)
            u = u + beyond * (saturate(wanted, feedforward, self._settings.limits) - u)
        return u

    def _descent(self, grid: ValueGrid, error: FloatArray, kappa: FloatArray) -> FloatArray:
        """Return g^T V_e at errors (..., 3), shape (..., 2)."""
        theta = error[..., 2]
        value, slope = grid.value_and_slope(error, kappa)
        backwards = np.abs(theta) > math.pi - _NOTCH
        if np.any(backwards):
            left, right = (
                grid.value_and_slope(_turned(error, angle), kappa)[0] for angle in (_NOTCH, -_NOTCH)
            )
            notch = backwards & ((left > value) != (right > value))
            slope[..., 2] = np.where(notch, 0.5 * (left - right) / _NOTCH, slope[..., 2])
        ahead = np.cos(theta) * slope[..., 0] + np.sin(theta) * slope[..., 1]
        return np.stack([ahead, slope[..., 2]], axis=-1)

    def _distant_input(
        self, value: DistantValue, error: FloatArray, kappa: FloatArray, feedforward: FloatArray
    ) -> FloatArray:
        """Return the input that turns to the best heading, shape (..., 2).

        To the side on which less is lost on the way: the Hamiltonian's excess over the least one,
        summed over the headings in between, is the value of a robot that only turns.
        """
        kappa = np.clip(kappa, -value.curvatures[-1], value.curvatures[-1])
        place, theta, count = error[..., :2], error[..., 2], len(HEADINGS)
        slope, limits = value.slope(place, kappa), self._settings.limits
        low, high = (
            np.asarray(bound[0] - feedforward[..., 0]) for bound in (limits.lower, limits.upper)
        )
        _, loss = self._problem.headings(place, kappa, slope, low, high)
        best = loss.argmin(axis=-1)[..., None]
        # From the best heading on, round to it again.
        loss = np.take_along_axis(loss, (best + np.arange(count)) % count, -1)
        before, least, after = loss[..., -1], loss[..., 0], loss[..., 1]
        between = 0.5 * (before - after) / np.maximum(before + after - 2.0 * least, 1e-9)
        ahead = np.mod(theta - HEADINGS[0] - (best[..., 0] + between) * _SPACING, 2.0 * math.pi)
        loss = loss - least[..., None]
        on_the_way = np.arange(count) * _SPACING < ahead[..., None]
        left, whole = (loss * on_the_way).sum(-1), loss.sum(-1)
        off = np.where(2.0 * left < whole, ahead, ahead - 2.0 * math.pi)
        pull = np.cos(theta) * slope[..., 0] + np.sin(theta) * slope[..., 1]
        v = -0.5 * self._inverse[0, 0] * pull
        return components(v, -_STEERING * off - feedforward[..., 1])


def _turned(error: FloatArray, angle: float) -> FloatArray:
    """Return errors (..., 3) of a robot that is turned by an angle [rad]."""
    found = error.copy()
    found[..., 2] = wrap_angle(error[..., 2] + angle)
    return found


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

    def __init__(
        self, settings: Settings, riccati: RiccatiSchedule, before: "WideRegion | None" = None
    ) -> None:
        """Take levels, limits and kind from the settings; lead over from the policy before."""
        self._settings, self._riccati = settings, riccati
        self._before, self._since = before, 0.0  # [s] from that one on
        if before is not None:
            before._before = None  # only one policy is left at a time
        self._kind = settings.policy.wide_region
        # Errors, in half-widths of the samples, between which the policy changes.
        self._levels = settings.policy.wide_region_levels
        self._half_widths = settings.half_widths
        if self._kind == "value_grid":
            start, end = self._levels
            self._levels = _GRID_LEVELS * start, _GRID_LEVELS * end
            self._half_widths[:2] *= min(1.0, problem_of(settings).length_scale)
        self._widths: list[float] = self._half_widths.tolist()
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

    def seen(self, zeta: FloatArray, arc_length: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the robot's states and the curvature [1/m] that the far policy is to count.

        The value on a grid knows circles only. That of a robot away from its target is the circle
        with the mean curvature, and the end, of the piece of path that comes until it is there.

        Args:
            zeta: States [s, y, theta, phi], shape (..., 4).
            arc_length: Places of the target [m], shape (...).

        """
        s, y = zeta[..., 0], zeta[..., 1]
        distance = np.maximum(s + _ASIDE * np.abs(y), 0.0)
        covered = _COMING_TIME * self._settings.target.target_gain * distance
        covered = np.minimum(covered, _MOST_COMING)
        places = np.asarray(arc_length)[..., None] + covered[..., None] * _PLACES
        frames = self._riccati.path.frame(places)
        curvature = frames.curvature @ _WEIGHTS
        robot = pose_in_frame(zeta[..., :3], frames.pose[..., 0, :])
        begin = advance_pose(frames.pose[..., -1, :], -covered, -covered * curvature, 1.0)
        return np.concatenate([tracking_error(robot, begin), zeta[..., 3:]], -1), curvature

    def blend(
        self,
        learned: FloatArray,
        arc_length: FloatArray,
        zeta: FloatArray,
        curvature: FloatArray,
        feedforward: FloatArray,
        dt: float = 0.0,
    ) -> FloatArray:
        """Return the modified input, shape (..., 2), learned near the path and this far from it.

        The learned input is within the limits, (..., 2), and the target at `arc_length` [m] (...);
        the rest is as in `modified_input`, dt [s] after the last step.
        """
        place = (arc_length, zeta, curvature, feedforward)
        here = self._alone(learned, *place)
        self._since += dt
        if self._since >= _CHANGE_TIME:
            self._before = None
        if self._before is None:
            return here
        before = self._before._alone(learned, *place)
        return before + self._since / _CHANGE_TIME * (here - before)

    def _alone(self, learned: FloatArray, *place: FloatArray) -> FloatArray:
        """Return the input as `blend`, without the policy before."""
        arc_length, zeta, curvature, feedforward = place
        share = self.share(zeta)[..., None]
        if not (share > 0.0).any():
            return learned
        if self._kind == "value_grid":
            zeta, curvature = self.seen(zeta, arc_length)
        far = np.asarray(self._far.modified_input(zeta, curvature, feedforward))
        far = saturate(far, feedforward, self._settings.limits) if self._is_own else far
        return np.asarray((1.0 - share) * learned + share * far)

    def share(self, error: FloatArray) -> FloatArray:
        """Return how much of the far policy drives at errors (..., 3 or 4), from 0 to 1, (...)."""
        if self._kind == "none" or (error.ndim == 1 and not self.is_far(error)):
            return np.zeros(error.shape[:-1])
        start, end = self._levels
        level = np.abs(error[..., :3] / self._half_widths).max(axis=-1)
        share = np.clip((level - start) / (end - start), 0.0, 1.0)
        return np.asarray(share * share * (3.0 - 2.0 * share))

    def is_far(self, error: FloatArray) -> bool:
        """Return whether a robot's error [s, y, theta, ...] is where another policy begins."""
        start = self._levels[0]
        return any(
            abs(value) > start * width
            for value, width in zip(error.tolist(), self._widths, strict=False)
        )
