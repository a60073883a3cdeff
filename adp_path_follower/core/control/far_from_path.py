"""The policy far from the path, where nothing is learned."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from adp_path_follower.core.control.fallback import RiccatiPolicy
from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray, components, wrap_angle
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


class WideRegion:
    """A policy that takes over from the learned one outside the region of the samples."""

    def __init__(self, settings: Settings, riccati: RiccatiSchedule) -> None:
        """Take levels, limits and kind from the settings."""
        self._policy = settings.policy
        self._half_widths = np.array(settings.learning.sample_half_widths[:3])
        self._widths: list[float] = self._half_widths.tolist()
        self._limits = settings.limits
        self._riccati = riccati
        inverse = np.linalg.inv(settings.cost.input_cost_matrix())
        self._input_cost_inverse: FloatArray = np.asarray(inverse, float)
        self._is_own = settings.policy.wide_region not in WIDE_REGIONS
        make = OWN_FAR_POLICIES.find(settings.policy.wide_region) if self._is_own else None
        self._far: FarPolicy = RiccatiPolicy(settings, riccati) if make is None else make(settings)

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
        start, end = self._policy.wide_region_levels
        if zeta.ndim == 1 and self._inside(zeta, start):
            return learned
        level = np.abs(zeta[..., :3] / self._half_widths).max(axis=-1)
        if not (level > start).any():
            return learned
        share = np.clip((level - start) / (end - start), 0.0, 1.0)
        share = (share * share * (3.0 - 2.0 * share))[..., None]
        if self._policy.wide_region == "approach":
            wanted = self._approach(zeta, self._riccati.matrix(curvature, feedforward[..., 0]))
            far = saturate(wanted, feedforward, self._limits)
        else:
            far = self._far.modified_input(zeta, curvature, feedforward)
            far = saturate(np.asarray(far), feedforward, self._limits) if self._is_own else far
        return np.asarray((1.0 - share) * learned + share * far)

    def _inside(self, zeta: FloatArray, level: float) -> bool:
        """Return whether a state (4,) is within a multiple of the samples' half-widths."""
        return all(
            abs(error) <= level * width
            for error, width in zip(zeta.tolist(), self._widths, strict=False)  # not phi
        )

    def _approach(self, zeta: FloatArray, matrix: FloatArray) -> FloatArray:
        """Return the Riccati law whose lateral part saturates into an approach angle, (..., 2).

        Its steering, -(P_yθ y + P_θθ θ) / R near the path, steers towards the heading
        -P_yθ y / P_θθ; limiting that heading below a right angle leaves no place from which a
        robot that cannot reverse would wait for ever. Its speed counts what a speed does at this
        heading, (cos θ, sin θ): far off course, more speed drives away from the target.
        """
        s, y, theta = (zeta[..., axis] for axis in range(3))
        slope = matrix[..., 1, 2] / matrix[..., 2, 2]
        widest = self._policy.approach_angle
        off_course = wrap_angle(theta + widest * np.tanh(slope * y / widest))
        ahead, aside = matrix[..., 0, 0] * s, matrix[..., 1, 1] * y
        pull = components(
            ahead * np.cos(theta) + aside * np.sin(theta), matrix[..., 2, 2] * off_course
        )
        return np.asarray(-pull @ self._input_cost_inverse)
