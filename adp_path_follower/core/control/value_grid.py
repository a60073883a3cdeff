"""The value function far from the path: a spline on a grid of errors and curvatures.

Far away the value is no polynomial: the cheapest way turns left here and right beside it. So

    V(e, kappa) = rho(e, kappa)^2 q^T P(kappa) q,

with the half-angle error q and the Riccati solution P, which take out the cone at the origin. rho
is a cubic spline in (s, y, theta), stretched in s and y and periodic in theta, and linear in kappa
between layers >= 0, as (y, theta, kappa) -> (-y, -theta, -kappa) changes nothing.

Farther away a turn on the spot takes no time worth speaking of: there W(s, y) is the value at the
best heading. The root of W by the distance is a spline in the distance's logarithm and the bearing.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from adp_path_follower.core.basis import Numbers
from adp_path_follower.core.geometry import (
    FloatArray,
    asinh,
    clamped,
    components,
    cos,
    hypot,
    log,
    number,
    numbers,
    sin,
    where,
)

_POWERS = np.arange(4)
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

    def position(self, s: FloatArray, y: FloatArray, theta: FloatArray) -> tuple[Numbers, Numbers]:
        """Return places [nodes] of errors (...) on the axes, and their derivatives, (...) each."""
        extent = math.asinh(self.reach / self.bend)
        places, slopes = [], []
        for length, count in ((s, self.shape[0]), (y, self.shape[1])):
            middle = 0.5 * (count - 1.0)
            inside = clamped(length, -self.reach, self.reach)
            places.append(middle + middle / extent * asinh(inside / self.bend))
            slopes.append(middle / extent / hypot(inside, self.bend) * (inside == length))
        turns = self.shape[2] / (2.0 * math.pi)
        return (*places, (theta + math.pi) * turns % self.shape[2]), (*slopes, turns)


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

    def position(self, s: FloatArray, y: FloatArray) -> Numbers:
        """Return places [nodes] of [s, y] (...) on the axes, (...) each."""
        outwards, around = self.spans
        distance = clamped(hypot(s, y), self.start, self.end)
        turned = (np.arctan2(y, s) + math.pi) * around % self.shape[1]
        return outwards * log(distance / self.start), turned


@dataclass(frozen=True)
class DistantValue:
    """W over places and curvatures."""

    axes: PolarAxes
    curvatures: FloatArray  # kappa of the layers [1/m], from 0 upwards, shape (K,)
    # Spline of the root of W by the distance in each layer, padded as that of `ValueGrid`, (K, ...)
    coefficients: FloatArray

    def slope(self, place: FloatArray, curvature: FloatArray) -> FloatArray:
        """Return W_s and W_y at places [s, y] (..., 2), for kappa [1/m] (...), shape (..., 2)."""
        kappa, (s, y) = number(curvature), numbers(place)
        left = where(kappa < 0.0, -1.0, 1.0)
        y = y * left
        node, weights = _taps(self.axes.position(s, y), self._windows)
        block = _between(self._windows, *_layer(self.curvatures, abs(kappa)), node)
        found = weights[..., 0, :, :] @ block @ weights[..., 1, :, :].swapaxes(-1, -2)
        ratio, by_bearing, by_logarithm, _ = numbers(found.reshape(*found.shape[:-2], 4))
        outwards, around = self.axes.spans
        by_distance, by_bearing = ratio + outwards * by_logarithm, around * by_bearing
        by_s, by_y = s * by_distance - y * by_bearing, y * by_distance + s * by_bearing
        return components(2.0 * ratio * by_s, 2.0 * ratio * by_y * left)

    @functools.cached_property
    def _windows(self) -> FloatArray:
        return _windows(self.coefficients)


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
        kappa, (s, y, theta) = number(curvature), numbers(error)
        left = where(kappa < 0.0, -1.0, 1.0)
        y, theta = y * left, theta * left
        layer, share = _layer(self.curvatures, abs(kappa))
        ratio, ratio_slope = self._ratio((s, y, theta), layer, share)
        matrix = _between(self.riccati, layer, share)
        base, base_slope = half_angle_form((s, y, theta), matrix)
        by_ratio, square = 2.0 * ratio * base, ratio * ratio
        by_s, by_y, by_theta = (
            by_ratio * steps + square * form
            for steps, form in zip(ratio_slope, base_slope, strict=True)
        )
        return square * base, components(by_s, by_y * left, by_theta * left)

    def _ratio(
        self, error: Numbers, layer: np.ndarray, share: FloatArray
    ) -> tuple[FloatArray, Numbers]:
        """Return rho, and its gradient by s, y and theta, shape (...) each."""
        places, (s_step, y_step, theta_step) = self.axes.position(*error)
        node, weights = _taps(places, self._windows)
        block = _between(self._windows, layer, share, node)
        by_theta = block @ weights[..., None, 2, :, :].swapaxes(-1, -2)  # (..., 4, 4, 2)
        by_y = weights[..., None, 1, :, :] @ by_theta  # (..., 4, 2, 2): value, slope
        found = weights[..., 0, :, :] @ by_y.reshape(*by_y.shape[:-2], 4)
        ratio, theta_slope, y_slope, _, s_slope, *_ = numbers(found.reshape(*found.shape[:-2], 8))
        return ratio, (s_slope * s_step, y_slope * y_step, theta_slope * theta_step)

    @functools.cached_property
    def _windows(self) -> FloatArray:
        return _windows(self.coefficients)


def _windows(layers: FloatArray) -> FloatArray:
    """Return the four coefficients along each axis from each on, as a view of all (K, ...)."""
    axes = layers.ndim - 1
    return sliding_window_view(layers, (4,) * axes, axis=tuple(range(1, axes + 1)))


def _layer(curvatures: FloatArray, curvature: FloatArray) -> tuple[np.ndarray, FloatArray]:
    """Return the layer below a curvature, and how far it is to the next, shape (...) each."""
    layer = np.searchsorted(curvatures, curvature, side="right") - 1
    layer = np.minimum(layer, len(curvatures) - 2)
    low, high = curvatures[layer], curvatures[layer + 1]
    return layer, np.minimum((curvature - low) / (high - low), 1.0)


def _between(
    layers: FloatArray, layer: np.ndarray, share: FloatArray, at: tuple[np.ndarray, ...] = ()
) -> FloatArray:
    """Return an array, or the one at some indices (...), between two layers (...)."""
    below, above = layers[(layer, *at)], layers[(layer + 1, *at)]
    return np.asarray(below + share[(..., *[None] * (below.ndim - share.ndim))] * (above - below))


def _taps(places: Numbers, windows: FloatArray) -> tuple[tuple[np.ndarray, ...], FloatArray]:
    """Return the window of four coefficients about places (...) [nodes], and their weights.

    The weights of each axis (..., axes, 2, 4) are those of value and slope.
    """
    place = components(*places)
    last = np.array(windows.shape[1 : len(places) + 1]) - 1.0
    node: Any = np.fmin(np.fmax(place, 0.0), last).astype(np.intp)  # 0 for NaN
    powers = (place - node)[..., None] ** _POWERS
    return numbers(node), (powers @ _BOTH).reshape(*place.shape, 2, 4)


def half_angle_form(error: Numbers, matrix: FloatArray) -> tuple[FloatArray, Numbers]:
    """Return q^T P q and its gradient, (...) each, at errors s, y, theta (...), P (..., 3, 3)."""
    s, y, theta = error
    ahead, aside = cos(0.5 * theta), sin(0.5 * theta)
    a, b = s * ahead + y * aside, y * ahead - s * aside
    p_aa, p_ab, p_at, _, p_bb, p_bt, *_, p_tt = numbers(matrix.reshape(*matrix.shape[:-2], 9))
    half_a = p_aa * a + p_ab * b + p_at * theta
    half_b = p_ab * a + p_bb * b + p_bt * theta
    half_theta = p_at * a + p_bt * b + p_tt * theta
    slope = (
        2.0 * (half_a * ahead - half_b * aside),
        2.0 * (half_a * aside + half_b * ahead),
        half_a * b - half_b * a + 2.0 * half_theta,
    )
    return a * half_a + b * half_b + theta * half_theta, slope
