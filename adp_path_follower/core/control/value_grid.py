"""The value function far from the path: a spline on a grid of errors and curvatures.

Far away the value is no polynomial: the cheapest way turns left here and right beside it. So

    V(e, kappa) = rho(e, kappa)^2 q^T P(kappa) q,

with the half-angle error q and the Riccati solution P, which take out the cone at the origin. rho
is a cubic spline in (s, y, theta), stretched in s and y and periodic in theta, and linear in kappa
between layers >= 0, as (y, theta, kappa) -> (-y, -theta, -kappa) changes nothing.

Farther away a turn on the spot takes no time worth speaking of: there W(s, y) is the value at the
best heading. The root of W by the distance is a spline in the distance's logarithm and the bearing.
"""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray, components, last_axis_sum

_TAPS = np.arange(4)
# Cubic B-spline: the rows are the powers 1, t, t^2, t^3 of the place between two nodes, the columns
# the four coefficients around it, for the value and then for its slope.
_SPLINE = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6.0
_SLOPE = np.array([[-3, 0, 3, 0], [6, -12, 6, 0], [-3, 9, -9, 3], [0, 0, 0, 0]]) / 6.0
_BOTH = np.hstack([_SPLINE, _SLOPE])


@dataclass(frozen=True)
class GridAxes:
    """Nodes in s, y and theta."""

    shape: tuple[int, int, int]  # number of nodes in s, y and theta
    reach: float  # largest |s| and |y| [m]
    bend: float  # distance [m] below which the nodes in s and y are about equally spaced

    @property
    def nodes(self) -> FloatArray:
        """Return s, y and theta of each node, shape (*shape, 3)."""
        extent = math.asinh(self.reach / self.bend)
        lengths = [self.bend * np.sinh(extent * np.linspace(-1.0, 1.0, n)) for n in self.shape[:2]]
        turns = -math.pi + 2.0 * math.pi / self.shape[2] * np.arange(self.shape[2])
        return np.stack(np.meshgrid(*lengths, turns, indexing="ij"), axis=-1)

    def position(self, error: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return places [nodes] of errors (..., 3) on the axes, and their derivatives, (..., 3)."""
        middle = 0.5 * (np.array(self.shape[:2]) - 1.0)
        spans = middle / math.asinh(self.reach / self.bend)
        turns = self.shape[2] / (2.0 * math.pi)
        place, slope = np.empty(error.shape), np.empty(error.shape)
        inside = np.minimum(np.maximum(error[..., :2], -self.reach), self.reach)
        place[..., :2] = middle + spans * np.arcsinh(inside / self.bend)
        slope[..., :2] = spans / np.hypot(inside, self.bend) * (inside == error[..., :2])
        place[..., 2] = np.mod((error[..., 2] + math.pi) * turns, self.shape[2])
        slope[..., 2] = turns
        return place, slope


@dataclass(frozen=True)
class PolarAxes:
    """Nodes in distance and bearing."""

    shape: tuple[int, int]  # number of nodes in distance and bearing
    start: float  # least and ...
    end: float  # ... largest distance [m]

    @property
    def nodes(self) -> FloatArray:
        """Return s, y and theta of each node, theta = 0, shape (*shape, 3)."""
        distance = np.geomspace(self.start, self.end, self.shape[0])[:, None]
        bearing = -math.pi + 2.0 * math.pi / self.shape[1] * np.arange(self.shape[1])
        s, y = distance * np.cos(bearing), distance * np.sin(bearing)
        return np.stack([s, y, np.zeros(self.shape)], axis=-1)

    @property
    def spans(self) -> tuple[float, float]:
        """Return nodes by the distance's logarithm, and by the bearing [1/rad]."""
        count, around = self.shape
        return (count - 1.0) / math.log(self.end / self.start), around / (2.0 * math.pi)

    def position(self, error: FloatArray) -> FloatArray:
        """Return places [nodes] of errors (..., 2 or 3) on the axes, (..., 2)."""
        s, y = error[..., 0], error[..., 1]
        outwards, around = self.spans
        distance = np.minimum(np.maximum(np.hypot(s, y), self.start), self.end)
        turned = np.mod((np.arctan2(y, s) + math.pi) * around, self.shape[1])
        return components(outwards * np.log(distance / self.start), turned)


@dataclass(frozen=True)
class DistantValue:
    """W over places and curvatures."""

    axes: PolarAxes
    curvatures: FloatArray  # kappa of the layers [1/m], from 0 upwards, shape (K,)
    # Spline of the root of W by the distance in each layer, padded as that of `ValueGrid`, (K, ...)
    coefficients: FloatArray

    def slope(self, place: FloatArray, curvature: FloatArray) -> FloatArray:
        """Return W_s and W_y at places [s, y] (..., 2), for kappa [1/m] (...), shape (..., 2)."""
        left = np.where(curvature < 0.0, -1.0, 1.0)
        s, y = place[..., 0], place[..., 1] * left
        layer, share = _layer(self.curvatures, np.abs(curvature))
        position = self.axes.position(components(s, y))
        node, weights = _taps(position, np.array(self.axes.shape) - (2, 1))
        outer, inner = np.moveaxis(node[..., None] + _TAPS, -2, 0)
        at = outer[..., :, None], inner[..., None, :]
        block = _between(self.coefficients, layer, share, at)
        found = weights[..., 0, :, :] @ block @ np.swapaxes(weights[..., 1, :, :], -1, -2)
        ratio, (outwards, around) = found[..., 0, 0], self.axes.spans
        by_distance = ratio + outwards * found[..., 1, 0]
        by_bearing = around * found[..., 0, 1]
        by_s, by_y = s * by_distance - y * by_bearing, y * by_distance + s * by_bearing
        return 2.0 * ratio[..., None] * components(by_s, by_y * left)


@dataclass(frozen=True)
class ValueGrid:
    """V over errors and curvatures."""

    axes: GridAxes  # the nodes in s, y and theta
    curvatures: FloatArray  # kappa of the layers [1/m], from 0 upwards, shape (K,)
    riccati: FloatArray  # P of each layer, shape (K, 3, 3)
    # Spline of rho in each layer, one more at each end of s and y, and three of theta, shape (K,
    # n_s + 2, n_y + 2, n_theta + 3).
    coefficients: FloatArray
    distant: DistantValue

    def value_and_slope(
        self, error: FloatArray, curvature: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return V (...) and its gradient by s, y, theta (..., 3) at errors (..., 3).

        theta is from -pi to pi; beyond the layers of kappa [1/m] (...), the last one counts.
        """
        left = np.where(curvature < 0.0, -1.0, 1.0)
        mirror = components(np.ones_like(left), left, left)
        layer, share = _layer(self.curvatures, np.abs(curvature))
        mirrored = error * mirror
        ratio, ratio_slope = self._ratio(mirrored, layer, share)
        part = share[..., None, None]
        matrix = (1.0 - part) * self.riccati[layer] + part * self.riccati[layer + 1]
        base, base_slope = half_angle_form(mirrored, matrix)
        slope = (2.0 * ratio * base)[..., None] * ratio_slope + (ratio**2)[..., None] * base_slope
        return ratio**2 * base, slope * mirror

    def _ratio(
        self, error: FloatArray, layer: np.ndarray, share: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return rho, shape (...), and its gradient by s, y and theta, shape (..., 3)."""
        place, stretch = self.axes.position(error)
        node, weights = _taps(place, np.array(self.axes.shape) - (2, 2, 1))
        weights[..., 1, :] *= stretch[..., None]
        rows = np.moveaxis(node[..., None] + _TAPS, -2, 0)
        at = rows[0][..., :, None, None], rows[1][..., None, :, None], rows[2][..., None, None, :]
        block = _between(self.coefficients, layer, share, at)
        by_theta = block @ np.swapaxes(weights[..., None, 2, :, :], -1, -2)  # (..., 4, 4, 2)
        by_y = weights[..., None, 1, :, :] @ by_theta  # (..., 4, 2, 2): value, slope
        found = weights[..., 0, :, :] @ by_y.reshape(*by_y.shape[:-2], 4)
        return found[..., 0, 0], components(found[..., 1, 0], found[..., 0, 2], found[..., 0, 1])


def _layer(curvatures: FloatArray, curvature: FloatArray) -> tuple[np.ndarray, FloatArray]:
    """Return the layer below a curvature, and how far it is to the next, shape (...) each."""
    layer = np.searchsorted(curvatures, curvature, side="right") - 1
    layer = np.minimum(layer, len(curvatures) - 2)
    low, high = curvatures[layer], curvatures[layer + 1]
    return layer, np.minimum((curvature - low) / (high - low), 1.0)


def _between(
    coefficients: FloatArray, layer: np.ndarray, share: FloatArray, at: tuple[np.ndarray, ...]
) -> FloatArray:
    """Return coefficients at indices (..., 4, 4 or 4, 4, 4) between two layers (...)."""
    around = (..., *[None] * len(at))
    below, above = (coefficients[(number[around], *at)] for number in (layer, layer + 1))
    return np.asarray(below + share[around] * (above - below))


def _taps(place: FloatArray, last: np.ndarray) -> tuple[np.ndarray, FloatArray]:
    """Return the first of four coefficients about places (..., axes) [nodes], and the weights.

    The weights of each axis (..., axes, 2, 4) are those of value and slope; `last` (axes,) is the
    first of the last two nodes.
    """
    with np.errstate(invalid="ignore"):
        node = np.minimum(np.maximum(place.astype(np.intp), 0), last)
    t = place - node
    powers = components(np.ones_like(t), t, t * t, t * t * t)
    return node, (powers @ _BOTH).reshape(*t.shape, 2, 4)


def half_angle_value(error: FloatArray, matrix: FloatArray) -> FloatArray:
    """Return q^T P q (...) at errors (..., 3), for P (..., 3, 3)."""
    _, _, q, pulled = _half_angle(error, matrix)
    return last_axis_sum(q * pulled)


def half_angle_form(error: FloatArray, matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return q^T P q (...) and its gradient (..., 3) at errors (..., 3), for P (..., 3, 3)."""
    cos, sin, q, pulled = _half_angle(error, matrix)
    by_a, by_b, by_theta = (2.0 * pulled[..., axis] for axis in range(3))
    turned = 0.5 * (by_a * q[..., 1] - by_b * q[..., 0]) + by_theta
    slope = components(by_a * cos - by_b * sin, by_a * sin + by_b * cos, turned)
    return last_axis_sum(q * pulled), slope


def _half_angle(error: FloatArray, matrix: FloatArray) -> tuple[FloatArray, ...]:
    """Return cos and sin of theta / 2 (...), and q and P q (..., 3)."""
    s, y, theta = error[..., 0], error[..., 1], error[..., 2]
    cos, sin = np.cos(0.5 * theta), np.sin(0.5 * theta)
    q = components(s * cos + y * sin, y * cos - s * sin, theta)
    return cos, sin, q, np.matmul(matrix, q[..., None])[..., 0]
