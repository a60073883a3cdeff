"""The value function far from the path: a spline on a grid of errors and curvatures.

Far away the value is no polynomial: the cheapest way turns left here and right beside it. So

    V(e, kappa) = rho(e, kappa)^2 q^T P(kappa) q,

with the half-angle error q and the Riccati solution P, which take out the cone at the origin. rho
is a cubic spline in (s, y, theta), stretched in s and y and periodic in theta, and linear in kappa
between layers >= 0, as (y, theta, kappa) -> (-y, -theta, -kappa) changes nothing.
"""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray

_TAPS = np.arange(4)
# Cubic B-spline: the rows are the powers 1, t, t^2, t^3 of the place between two nodes, the columns
# the four coefficients around it.
_SPLINE = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6.0


@dataclass(frozen=True)
class GridAxes:
    """Nodes in s, y and theta."""

    shape: tuple[int, int, int]  # number of nodes in s, y and theta
    reach: float  # largest |s| and |y| [m]
    bend: float  # distance [m] below which the nodes in s and y are about equally spaced

    @property
    def nodes(self) -> FloatArray:
        """Return s, y and theta of each node, shape (3, *shape)."""
        extent = math.asinh(self.reach / self.bend)
        lengths = [self.bend * np.sinh(extent * np.linspace(-1.0, 1.0, n)) for n in self.shape[:2]]
        turns = -math.pi + 2.0 * math.pi / self.shape[2] * np.arange(self.shape[2])
        return np.stack(np.meshgrid(*lengths, turns, indexing="ij"))

    def position(self, error: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return places [nodes] of errors (3, ...) on the axes, and their derivatives, (3, ...)."""
        spans = 0.5 * (np.array(self.shape[:2]) - 1.0) / math.asinh(self.reach / self.bend)
        turns = self.shape[2] / (2.0 * math.pi)
        place, slope = np.empty(error.shape), np.empty(error.shape)
        for axis in range(2):
            inside = np.clip(error[axis], -self.reach, self.reach)
            place[axis] = spans[axis] * np.arcsinh(inside / self.bend)
            place[axis] += 0.5 * (self.shape[axis] - 1.0)
            slope[axis] = spans[axis] / np.hypot(inside, self.bend) * (inside == error[axis])
        place[2] = np.mod((error[2] + math.pi) * turns, self.shape[2])
        slope[2] = turns
        return place, slope


@dataclass(frozen=True)
class ValueGrid:
    """V over errors and curvatures."""

    axes: GridAxes  # the nodes in s, y and theta
    curvatures: FloatArray  # kappa of the layers [1/m], from 0 upwards, shape (K,)
    riccati: FloatArray  # P of each layer, shape (K, 3, 3)
    # Spline of rho in each layer, one more at each end of s and y, and three of theta, shape (K,
    # n_s + 2, n_y + 2, n_theta + 3).
    coefficients: FloatArray

    def value_and_slope(
        self, error: FloatArray, curvature: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return V (...) and its gradient by s, y, theta (..., 3) at errors (..., 3).

        theta is from -pi to pi; beyond the layers of kappa [1/m] (...), the last one counts.
        """
        left = np.where(np.asarray(curvature) < 0.0, -1.0, 1.0)
        mirror = np.stack([np.ones_like(left), left, left], axis=-1)
        layer, share = self._layer(np.abs(curvature))
        mirrored = error * mirror
        ratio, ratio_slope = self._ratio(mirrored, layer, share)
        part = share[..., None, None]
        matrix = (1.0 - part) * self.riccati[layer] + part * self.riccati[layer + 1]
        base, base_slope = half_angle_form(mirrored, matrix)
        slope = (2.0 * ratio * base)[..., None] * ratio_slope + (ratio**2)[..., None] * base_slope
        return ratio**2 * base, slope * mirror

    def _layer(self, curvature: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """Return the layer below a curvature, and how far it is to the next, shape (...) each."""
        layer = np.searchsorted(self.curvatures, curvature, side="right") - 1
        layer = np.minimum(layer, len(self.curvatures) - 2)
        low, high = self.curvatures[layer], self.curvatures[layer + 1]
        return layer, np.minimum((curvature - low) / (high - low), 1.0)

    def _ratio(
        self, error: FloatArray, layer: np.ndarray, share: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return rho, shape (...), and its gradient by s, y and theta, shape (..., 3)."""
        place, stretch = self.axes.position(np.moveaxis(error, -1, 0))
        last = np.array(self.axes.shape) - (2, 2, 1)  # the first of the last two nodes
        last = last.reshape(3, *(1,) * (place.ndim - 1))
        with np.errstate(invalid="ignore"):
            node = np.clip(place.astype(np.intp), 0, last)  # also of an error that is none
        t = place - node
        powers = np.stack([np.ones_like(t), t, t * t, t**3], axis=-1)
        rates = np.stack([np.zeros_like(t), np.ones_like(t), 2.0 * t, 3.0 * t * t], axis=-1)
        weights = np.stack([powers @ _SPLINE, rates @ _SPLINE * stretch[..., None]], axis=-1)
        rows = [node[axis][..., None] + _TAPS for axis in range(3)]
        at = rows[0][..., :, None, None], rows[1][..., None, :, None], rows[2][..., None, None, :]
        below = self.coefficients[(layer[..., None, None, None], *at)]
        above = self.coefficients[(layer[..., None, None, None] + 1, *at)]
        block = below + share[..., None, None, None] * (above - below)
        by_theta = block @ weights[2][..., None, :, :]  # (..., 4, 4, 2): value, slope
        by_y = np.swapaxes(weights[1], -1, -2)[..., None, :, :] @ by_theta  # (..., 4, 2, 2)
        first = np.einsum("...ai,...ajk->...ijk", weights[0], by_y)
        return first[..., 0, 0, 0], np.stack(
            [first[..., 1, 0, 0], first[..., 0, 1, 0], first[..., 0, 0, 1]], axis=-1
        )


def half_angle_form(error: FloatArray, matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return q^T P q (...) and its gradient (..., 3) at errors (..., 3), for P (..., 3, 3)."""
    s, y, theta = error[..., 0], error[..., 1], error[..., 2]
    cos, sin = np.cos(0.5 * theta), np.sin(0.5 * theta)
    a, b = s * cos + y * sin, y * cos - s * sin
    q = np.stack([a, b, theta], axis=-1)
    pulled = np.matmul(matrix, q[..., None])[..., 0]
    by_a, by_b, by_theta = (2.0 * pulled[..., axis] for axis in range(3))
    slope = [by_a * cos - by_b * sin, by_a * sin + by_b * cos]
    slope.append(0.5 * (by_a * b - by_b * a) + by_theta)
    return (q * pulled).sum(-1), np.stack(slope, axis=-1)
