"""Paths by arc length: pose and curvature at s_p, from points or from a formula."""

from __future__ import annotations

import functools
import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.errors import PathError
from adp_path_follower.core.geometry import FloatArray, components, contiguous, unpacked
from adp_path_follower.core.path.points import chord_spline, distinct_points, in_blocks, joined

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline  # imported where paths are made, as in `points`

_DEGREE = 5  # of the pieces: curvature is then twice differentiable
_PIECE = 0.05  # [m]
_LEAST_PIECES, _MOST_PIECES = 64, 100_000  # the most take 30 MB
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(5)
_SPACING = 0.02  # [m] of places where the path is sampled, at most ...
_MOST_PLACES = 100_000  # ... so many pieces
_NEWTON_STEPS = 8


class TurningBackError(PathError):
    """Report a path that turns back on itself, and where: x, y [m]."""

    def __init__(self, x: float, y: float) -> None:
        super().__init__(
            f"path turns back on itself, or has too sharp a corner, near ({x:.2f}, {y:.2f}): "
            "smooth it there, or cut it into two paths"
        )
        self.place = (x, y)


@dataclass(frozen=True)
class PathFrame:
    """The Serret-Frenet frame of a path at one or many arc lengths."""

    pose: FloatArray  # x [m], y [m] and tangent angle theta_f [rad], shape (..., 3)
    curvature: FloatArray  # kappa [1/m], positive to the left, shape (...)


@dataclass(frozen=True)
class PathSamples:
    """Places along a path, shape (M,) each."""

    arc_length: FloatArray  # s_p [m]
    x: FloatArray  # position [m]
    y: FloatArray  # position [m]
    cos: FloatArray  # cosine of the heading
    sin: FloatArray  # sine of the heading
    curvature: FloatArray  # kappa [1/m]


class Path:
    """A planar path as pieces of fifth degree in arc length.

    A closed path has no ends: arc length grows over the laps. Beyond the ends of an open path
    its tangents continue as straight lines.
    """

    def __init__(self, coefficients: FloatArray, length: float, closed: bool) -> None:
        """Take the pieces of a twice differentiable curve, each of the same arc length.

        The coefficients are those of x and y by ascending powers of the arc length from the start
        of each piece, shape (pieces, 2, degree + 1); the length of the whole path is in metres.
        """
        pieces, _, terms = coefficients.shape
        self.length = length
        self.closed = closed
        self._pieces = pieces
        self._step = self.length / pieces
        # Row r of a piece's block holds the coefficients of (x, y, x', y', x'', y'')[r] by
        # ascending powers, so that evaluating a path is one gather and one matrix product.
        derivatives = np.zeros((pieces, 3, 2, terms))
        derivatives[:, 0] = coefficients
        for order in (1, 2):
            derivatives[:, order, :, :-1] = derivatives[:, order - 1, :, 1:] * np.arange(1, terms)
        self._blocks = derivatives.reshape(pieces, 6, terms)
        self._degrees = np.arange(float(terms))

    def __repr__(self) -> str:
        """Return the kind and the length in one line."""
        return f"Path({'closed' if self.closed else 'open'}, {self.length:.3f} m)"

    @classmethod
    def from_points(cls, points: ArrayLike, closed: bool | None = None) -> Path:
        """Return the path through points, shape (N, 2) [m]; a C2 spline over their chord lengths.

        Neighbours that coincide count once. `closed` says whether the last point joins the first,
        None that coinciding ends (1 mm) do. Raises PathError for fewer than two distinct points,
        more than a million, a value that is not finite, or points that turn back on themselves.
        """
        distinct, closed = joined(distinct_points(points)[0], closed)
        return cls.along(*chord_spline(distinct, closed), closed)

    @classmethod
    def along(
        cls, spline: CubicSpline, parameter: FloatArray, closed: bool, piece: float | None = None
    ) -> Path:
        """Return the path by arc length along a C2 spline, which maps parameters to points [m].

        Its pieces meet at increasing parameters. Those of the path have the length `piece` [m], by
        default a quarter of the usual one, but at most 5 cm. Raises TurningBackError at a cusp.
        """
        if piece is None:
            piece = 0.25 * float(np.median(np.diff(parameter)))
        return cls.from_curve(spline, spline.derivative(), parameter, closed, min(_PIECE, piece))

    @classmethod
    def from_curve(
        cls,
        position: Callable[[FloatArray], FloatArray],
        velocity: Callable[[FloatArray], FloatArray],
        parameters: FloatArray,
        closed: bool,
        piece: float = _PIECE,
    ) -> Path:
        """Return the path of a smooth curve by its arc length, in pieces of some length [m].

        `position` maps increasing parameters (M,) to points (M, 2) [m]; `velocity`, its derivative,
        is never zero. A closed curve ends where it starts.
        """
        from scipy.interpolate import make_interp_spline

        arc = _ArcLength(velocity, parameters)
        pieces = min(max(_LEAST_PIECES, math.ceil(arc.length / piece)), _MOST_PIECES)
        knots = np.linspace(0.0, arc.length, pieces + 1)
        points = in_blocks(position, arc.parameter(knots))
        if closed:
            points[-1] = points[0]
        spline = make_interp_spline(
            knots, points, k=_DEGREE, bc_type="periodic" if closed else None
        )
        coefficients = [
            in_blocks(functools.partial(spline, nu=power), knots[:-1]) / math.factorial(power)
            for power in range(_DEGREE + 1)
        ]
        path = cls(np.stack(coefficients, axis=-1), arc.length, closed)
        path._refuse_turning_back()
        return path

    def frame(self, arc_length: ArrayLike) -> PathFrame:
        """Return pose and curvature at arc lengths s_p [m] of any shape."""
        position = np.asarray(arc_length, dtype=float)
        if position.ndim == 0:
            return self._frame_at(float(position))
        beyond = None
        if self.closed:
            inside = position - self.length * np.floor(position / self.length)
        else:
            inside = np.minimum(np.maximum(position, 0.0), self.length)
            beyond = position - inside
        # fmin and fmax pass over NaN, which then comes out as a NaN pose.
        piece = np.fmin(np.fmax(inside / self._step, 0.0), self._pieces - 1).astype(np.intp)
        powers = (inside - piece * self._step)[..., None] ** self._degrees
        values = np.matmul(self._blocks[piece], powers[..., None])[..., 0]
        x, y, dx, dy, ddx, ddy = unpacked(values)
        heading = np.arctan2(contiguous(dy), contiguous(dx))
        curvature = (dx * ddy - dy * ddx) / (dx * dx + dy * dy) ** 1.5
        if beyond is not None:
            curvature = np.where(beyond == 0.0, curvature, 0.0)[()]
            x, y = x + beyond * np.cos(heading), y + beyond * np.sin(heading)
        return PathFrame(components(x, y, heading), curvature)

    def _frame_at(self, position: float) -> PathFrame:
        """Return the frame at a single place [m], in half the time that one of many takes."""
        inside = min(max(position, 0.0), self.length)
        if self.closed:
            inside = position - self.length * (position / self.length // 1.0)
        beyond = 0.0 if self.closed else position - inside
        piece = min(int(max(0.0, inside / self._step)), self._pieces - 1)  # 0 for NaN
        powers = (inside - piece * self._step) ** self._degrees
        x, y, dx, dy, ddx, ddy = self._blocks[piece].dot(powers).tolist()
        heading = np.arctan2(dy, dx)
        curvature: Any = np.float64((dx * ddy - dy * ddx) / (dx * dx + dy * dy) ** 1.5)
        if beyond != 0.0:
            curvature = np.float64(0.0)
            x, y = x + beyond * np.cos(heading), y + beyond * np.sin(heading)
        return PathFrame(np.array([x, y, heading]), curvature)

    def check_place(self, arc_length: float) -> None:
        """Raise PathError if an arc length [m] is not finite, or beyond an open path's ends."""
        inside = 0.0 <= arc_length <= self.length
        if not (inside or (self.closed and math.isfinite(arc_length))):
            raise PathError(
                f"start_arc_length is {arc_length:g} m, but the path is {self.length:.2f} m long"
            )

    def curvature(self, arc_length: ArrayLike) -> FloatArray:
        """Return the path curvature kappa [1/m] at each arc length, same shape."""
        return self.frame(arc_length).curvature

    @functools.cached_property
    def curvature_range(self) -> tuple[float, float]:
        """Return the least and the greatest curvature [1/m], as seen at every piece's start."""
        curvature = self.curvature(np.arange(self._pieces + 1) * self._step)
        return float(curvature.min()), float(curvature.max())

    def points(self, spacing: float = 0.05) -> FloatArray:
        """Return poses at most `spacing` [m] apart, (N, 3); closed, the last equals the first."""
        count = max(2, math.ceil(self.length / spacing) + 1)
        poses = self.frame(np.linspace(0.0, self.length, count)).pose
        if self.closed:
            poses[-1] = poses[0]
        return poses

    def make_ready(self) -> None:
        """Compute the caches that the first control step on the path needs."""
        self.digest()
        _ = self.curvature_range, self.samples

    @functools.cached_property
    def samples(self) -> PathSamples:
        """Return equidistant places at most 2 cm apart, but no more than 100,001 (above 2 km)."""
        pieces = min(max(2, math.ceil(self.length / _SPACING)), _MOST_PLACES)
        arc_length = np.linspace(0.0, self.length, pieces + 1)
        frame = self.frame(arc_length)
        x, y, heading = frame.pose.T
        return PathSamples(
            arc_length, x.copy(), y.copy(), np.cos(heading), np.sin(heading), frame.curvature
        )

    def digest(self) -> str:
        """Return a hash of the path's coefficients: equal digests are equal paths."""
        return self._digest

    @functools.cached_property
    def _digest(self) -> str:
        content = hashlib.sha256(self._blocks.tobytes())
        content.update(np.array([self.length, self.closed]).tobytes())
        return content.hexdigest()[:16]

    def _refuse_turning_back(self) -> None:
        """Raise where the spline is not a path by arc length: a cusp or a reversal."""
        middles = (np.arange(self._pieces) + 0.5) * self._step
        values = self._blocks[:, 2:4] @ (0.5 * self._step) ** self._degrees
        speed = np.linalg.norm(values, axis=1)
        worst = int(np.argmax(np.abs(speed - 1.0)))
        if abs(speed[worst] - 1.0) > 0.1:
            x, y, _ = self.frame(middles[worst]).pose
            raise TurningBackError(float(x), float(y))


class _ArcLength:
    """Arc length along a curve, and back, by Gauss-Legendre quadrature between breaks."""

    def __init__(self, velocity: Callable[[FloatArray], FloatArray], breaks: FloatArray) -> None:
        self._velocity = velocity
        self._breaks = breaks
        lengths = self._integrate(breaks[:-1], breaks[1:])
        self._lengths = np.concatenate([[0.0], np.cumsum(lengths)])
        self.length = float(self._lengths[-1])

    def _integrate(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        half = 0.5 * (stop - start)
        nodes = (0.5 * (start + stop))[:, None] + half[:, None] * _GAUSS_NODES
        speed = self._speed(nodes.ravel()).reshape(nodes.shape)
        return np.asarray(half * (speed @ _GAUSS_WEIGHTS))

    def _speed(self, parameter: FloatArray) -> FloatArray:
        velocity = in_blocks(self._velocity, parameter)
        return np.hypot(velocity[:, 0], velocity[:, 1])

    def parameter(self, arc_length: FloatArray) -> FloatArray:
        """Return the curve's parameter at arc lengths, by Newton's method on each interval."""
        index = np.searchsorted(self._lengths, arc_length, side="right") - 1
        index = np.clip(index, 0, len(self._breaks) - 2)
        low, high = self._breaks[index], self._breaks[index + 1]
        rest = arc_length - self._lengths[index]
        interval = self._lengths[index + 1] - self._lengths[index]
        parameter = low + (high - low) * rest / interval
        for _ in range(_NEWTON_STEPS):
            speed = self._speed(parameter)
            miss = self._integrate(low, parameter) - rest
            parameter = np.clip(parameter - miss / np.maximum(speed, 1e-12), low, high)
            if np.abs(miss).max() < 1e-9 * float(self._lengths[-1] / len(self._breaks)):
                break  # the step just made squares that
        return np.asarray(parameter)
