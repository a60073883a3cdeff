"""The policy far from the path, where nothing is learned."""

import dataclasses
import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from adp_path_follower.core.control.fallback import RiccatiPolicy
from adp_path_follower.core.control.policy import descending_input, saturate
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.control.value_iteration import ValueProblem
from adp_path_follower.core.control.value_store import problem_of, stored, value_grid
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray, components, wrap_angle
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


# [m] between which the approach takes over: the nodes are too rare there. Less below 0.5 m/s, and
# more above 2 m/s, by the root of `ValueProblem.length_scale`.
_GRID_ENDS = np.array([11.0, 14.0])
# [rad] from facing backwards, within which the slope by theta is taken over as much to both sides:
# the heading of the half-angle form has a kink there, in whose notch robots would stay for ever.
_NOTCH = 0.25
_FASTEST = 1e3  # [m/s] where there is no limit
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


def far_levels(settings: Settings) -> tuple[float, float]:
    """Return the errors, in half-widths of the samples, between which the policy changes."""
    start, end = settings.policy.wide_region_levels
    scale = _GRID_LEVELS if settings.policy.wide_region == "value_grid" else 1.0
    return scale * start, scale * end


class GridPolicy:
    """The policy of the value function on a grid, which is found when the first robot needs it."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._grid = stored(problem_of(settings))
        self._input_cost_inverse = settings.cost.inverse_input_cost()

    def modified_input(
        self, zeta: FloatArray, curvature: FloatArray, feedforward: FloatArray
    ) -> FloatArray:
        """Return u = -1/2 R^-1 g^T V_e within the limits, shape (..., 2)."""
        error = zeta[..., :3]
        if self._grid is None:
            self._grid = value_grid(self._settings)
        grid, kappa, theta = self._grid, np.asarray(curvature), error[..., 2]
        value, slope = grid.value_and_slope(error, kappa)
        backwards = np.abs(theta) > math.pi - _NOTCH
        if np.any(backwards):
            left, right = (
                grid.value_and_slope(_turned(error, angle), kappa)[0] for angle in (_NOTCH, -_NOTCH)
            )
            notch = backwards & ((left > value) != (right > value))
            slope[..., 2] = np.where(notch, 0.5 * (left - right) / _NOTCH, slope[..., 2])
        ahead = np.cos(theta) * slope[..., 0] + np.sin(theta) * slope[..., 1]
        descent = np.stack([ahead, slope[..., 2]], axis=-1)
        wanted = descending_input(descent, self._input_cost_inverse)
        return saturate(wanted, feedforward, self._settings.limits)


def _turned(error: FloatArray, angle: float) -> FloatArray:
    """Return errors (..., 3) of a robot that is turned by an angle [rad]."""
    found = error.copy()
    found[..., 2] = wrap_angle(error[..., 2] + angle)
    return found


class WideRegion:
    """A policy that takes over from the learned one outside the region of the samples."""

    def __init__(self, settings: Settings, riccati: RiccatiSchedule) -> None:
        """Take levels, limits and kind from the settings."""
        self._policy, self._kind = settings.policy, settings.policy.wide_region
        self._levels = far_levels(settings)
        self._half_widths = settings.half_widths
        scale = problem_of(settings).length_scale
        self._grid_ends = math.sqrt(scale) * _GRID_ENDS
        if self._kind == "value_grid":
            self._half_widths[:2] *= min(1.0, scale)
        self._widths: list[float] = self._half_widths.tolist()
        self._limits = settings.limits
        self._state_cost = settings.cost.state_cost_matrix()
        self._target_gain = settings.target.target_gain
        self._riccati = riccati
        self._input_cost_inverse = settings.cost.inverse_input_cost()
        self._is_own = settings.policy.wide_region not in WIDE_REGIONS
        make = OWN_FAR_POLICIES.find(settings.policy.wide_region) if self._is_own else None
        self._far: FarPolicy
        if make is not None:
            self._far = make(settings)
        elif self._kind == "value_grid":
            self._far = GridPolicy(settings)
        else:
            self._far = RiccatiPolicy(settings, riccati)

    def blend(
        self,
        learned: FloatArray,
        zeta: FloatArray,
        curvature: FloatArray,
        feedforward: FloatArray,
    ) -> FloatArray:
        """Return the modified input, shape (..., 2), learned near the path and this far from it.

        The learned input is within the limits, (..., 2); the rest is as in `modified_input`.
        """
        share = self.share(zeta)[..., None]
        if not (share > 0.0).any():
            return learned
        beyond = self._beyond_grid(zeta)
        far = np.zeros_like(learned)
        if (beyond < 1.0).any():
            far = self._far.modified_input(zeta, curvature, feedforward)
            far = saturate(np.asarray(far), feedforward, self._limits) if self._is_own else far
        if (beyond > 0.0).any():
            v_des = feedforward[..., 0]
            wanted = self._approach(zeta, self._riccati.matrix(curvature, v_des), v_des)
            approach = saturate(wanted, feedforward, self._limits)
            far = far + beyond * (approach - far)
        return np.asarray((1.0 - share) * learned + share * far)

    def _beyond_grid(self, zeta: FloatArray) -> FloatArray:
        """Return how much of the approach drives instead of the far policy, shape (..., 1)."""
        if self._kind != "value_grid":
            return np.full((*zeta.shape[:-1], 1), float(self._kind == "approach"))
        distance = np.hypot(zeta[..., 0], zeta[..., 1])[..., None]
        start, end = self._grid_ends
        return np.asarray(np.clip((distance - start) / (end - start), 0.0, 1.0))

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

    def _approach(self, zeta: FloatArray, matrix: FloatArray, v_des: FloatArray) -> FloatArray:
        """Return the Riccati law whose lateral part saturates into an approach angle, (..., 2).

        Its steering, -(P_yθ y + P_θθ θ) / R near the path, steers towards the heading
        -P_yθ y / P_θθ; limiting that heading below a right angle leaves no place from which a
        robot that cannot reverse would wait for ever. Its speed counts what a speed does at this
        heading, (cos θ, sin θ): far off course, more speed drives away from the target.
        """
        s, y, theta = (zeta[..., axis] for axis in range(3))
        slope = matrix[..., 1, 2] / matrix[..., 2, 2]
        widest = self._widest_angle(s, y, matrix, v_des)
        off_course = wrap_angle(theta + widest * np.tanh(slope * y / widest))
        ahead, aside = matrix[..., 0, 0] * s, matrix[..., 1, 1] * y
        pull = components(
            ahead * np.cos(theta) + aside * np.sin(theta), matrix[..., 2, 2] * off_course
        )
        return np.asarray(-pull @ self._input_cost_inverse)

    def _widest_angle(
        self, s: FloatArray, y: FloatArray, matrix: FloatArray, v_des: FloatArray
    ) -> FloatArray:
        """Return the largest angle to the path [rad] that pays, shape (...).

        It is smaller where the robot is far behind its target, which it gains on only by driving
        along the path. There V_s is about Q_ss s^2 by the speed at which s shrinks, and V_y about
        P_yy y or, far aside, Q_yy y^2 by the robot's speed.
        """
        state_cost, behind = self._state_cost, np.minimum(s, 0.0)
        in_hand = np.maximum(min(float(self._limits.upper[0]), _FASTEST) - v_des, 0.0)
        shrinks = np.maximum(in_hand - self._target_gain * behind, 1e-9)
        ahead = state_cost[0, 0] * behind**2 * in_hand / shrinks
        aside = state_cost[1, 1] * y**2 + matrix[..., 1, 1] * np.abs(y) * v_des
        pays = np.maximum(np.arctan2(aside, ahead), 1e-6)
        return np.asarray(np.minimum(pays, self._policy.approach_angle))
