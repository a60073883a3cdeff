"""The policy far from the path, where nothing is learned."""

from __future__ import annotations

import numpy as np

from adp_path_follower.core.control.fallback import RiccatiPolicy
from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray, components, wrap_angle
from adp_path_follower.core.settings.groups import Settings


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
        self._quadratic = RiccatiPolicy(settings, riccati)

    def blend(
        self,
        learned: FloatArray,
        zeta: FloatArray,
        curvature: FloatArray,
        feedforward: FloatArray,
    ) -> FloatArray:
        """Return the modified input, shape (..., 2), learned near the path and this far from it.

        Args:
            learned: The learned policy's input, within the limits, shape (..., 2).
            zeta: States, shape (..., 4).
            curvature: kappa at the target [1/m], shape (...).
            feedforward: [v_ss, w_ss], shape (..., 2).

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
            wanted = self._approach(zeta, self._riccati.matrix(curvature, feedforward[..., 0][()]))
            far = saturate(wanted, feedforward, self._limits)
        else:
            far = self._quadratic.modified_input(zeta, curvature, feedforward)
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
