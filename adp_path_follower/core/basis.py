"""Bases of the value function: sigma(zeta) and its gradient sigma'(zeta)."""

from __future__ import annotations

import functools
from typing import Protocol

import numpy as np

from adp_path_follower.core.geometry import FloatArray, unpacked

STATE_LABELS = ("s", "y", "θ", "φ")


class Basis(Protocol):
    """What the learner asks of a basis."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the name of each term, length L."""

    def value(self, zeta: FloatArray) -> FloatArray:
        """Return sigma at states of shape (..., 4), shape (..., L)."""

    @property
    def depends_on_path_state(self) -> bool:
        """Return whether phi is among the variables."""

    def gradient(self, zeta: FloatArray) -> FloatArray:
        """Return sigma' at states of shape (..., 4), shape (..., L, 4)."""

    def value_and_gradient(self, zeta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return sigma and sigma' at states of shape (..., 4), which share their powers."""

    def quadratic_weights(self, matrix: FloatArray) -> FloatArray:
        """Return the weights of e^T P e to second order for P (..., 3, 3), shape (..., L)."""


class QuadraticBasis:
    """A basis of products of two states, and of single states."""

    def __init__(
        self, products: tuple[tuple[int, int], ...], singles: tuple[int, ...] = ()
    ) -> None:
        """Prepare the constant arrays: sigma' is an affine map of zeta.

        Args:
            products: Index pairs (i, j), one for each term zeta_i zeta_j.
            singles: Indices i, one for each term zeta_i; they stand last.

        """
        self._products, self._singles = products, singles
        size, count = len(products) + len(singles), len(STATE_LABELS)
        self._slope = np.zeros((size, count, count))
        for term, (i, j) in enumerate(products):
            self._slope[term, i, j] += 1.0
            self._slope[term, j, i] += 1.0
        self._offset = np.zeros((size, count))
        for term, i in enumerate(singles, start=len(products)):
            self._offset[term, i] = 1.0
        self._flat_slope = self._slope.reshape(size * count, count).T.copy()

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the name of each term, length L, such as "s y" or "θ²"."""
        names = STATE_LABELS
        products = [
            f"{names[i]}²" if i == j else f"{names[i]} {names[j]}" for i, j in self._products
        ]
        return (*products, *(names[i] for i in self._singles))

    def value(self, zeta: FloatArray) -> FloatArray:
        """Return sigma at states of shape (..., 4), shape (..., L)."""
        quadratic = 0.5 * np.einsum("...i,lij,...j->...l", zeta, self._slope, zeta)
        return np.asarray(quadratic + zeta @ self._offset.T)

    def gradient(self, zeta: FloatArray) -> FloatArray:
        """Return sigma' at states of shape (..., 4), shape (..., L, 4)."""
        slope = (zeta @ self._flat_slope).reshape(*zeta.shape[:-1], *self._offset.shape)
        return np.asarray(slope + self._offset)

    def value_and_gradient(self, zeta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return sigma and sigma' at states of shape (..., 4)."""
        return self.value(zeta), self.gradient(zeta)

    @property
    def depends_on_path_state(self) -> bool:
        """Return whether phi is among the variables."""
        return any(3 in product for product in self._products) or 3 in self._singles

    def quadratic_weights(self, matrix: FloatArray) -> FloatArray:
        """Return the weights of the value function e^T P e for P (..., 3, 3), shape (..., L)."""
        weights = np.zeros((*matrix.shape[:-2], len(self.labels)))
        for term, (i, j) in enumerate(self._products):
            if j < 3:
                weights[..., term] = matrix[..., i, j] * (1.0 if i == j else 2.0)
        return weights


class PolynomialBasis:
    """All monomials of the error e = [s, y, theta] from degree 2 to a highest degree."""

    def __init__(self, degree: int) -> None:
        """Prepare the exponents, by rising degree: the quadratic terms come first."""
        self.degree = degree
        self._exponents = np.array(
            [
                (i, j, total - i - j)
                for total in range(2, degree + 1)
                for i in range(total, -1, -1)
                for j in range(total - i, -1, -1)
            ]
        )
        # Where the power of each variable stands in a table of powers, and that of its derivative.
        first = np.arange(3)[:, None] * (degree + 1)
        self._columns = first + self._exponents.T
        self._derivative_columns = first + np.maximum(self._exponents.T - 1, 0)
        self._factors = self._exponents.T.astype(float)

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the name of each term, length L, such as "s y" or "s y² θ"."""
        names = STATE_LABELS
        return tuple(
            " ".join(
                names[axis] + ("" if power == 1 else str(power).translate(_SUPERSCRIPTS))
                for axis, power in enumerate(powers)
                if power
            )
            for powers in self._exponents.tolist()
        )

    @property
    def depends_on_path_state(self) -> bool:
        """Return whether phi is among the variables: never."""
        return False

    def value(self, zeta: FloatArray) -> FloatArray:
        """Return sigma at states of shape (..., 4), shape (..., L)."""
        return np.asarray(self._powers(zeta).take(self._columns, axis=-1).prod(axis=-2))

    def gradient(self, zeta: FloatArray) -> FloatArray:
        """Return sigma' at states of shape (..., 4), shape (..., L, 4)."""
        return self.value_and_gradient(zeta)[1]

    def value_and_gradient(self, zeta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return sigma and sigma' at states of shape (..., 4)."""
        powers = self._powers(zeta)
        power = powers.take(self._columns, axis=-1)
        slope = powers.take(self._derivative_columns, axis=-1)
        slope *= self._factors
        s, y, theta = (power[..., axis, :] for axis in range(3))
        # sigma' transposed: terms side by side in memory are what products with it are fast for.
        transposed = np.zeros((*zeta.shape[:-1], len(STATE_LABELS), len(self._exponents)))
        position = s * y
        np.multiply(slope[..., 0, :], y * theta, out=transposed[..., 0, :])
        np.multiply(slope[..., 1, :], s * theta, out=transposed[..., 1, :])
        np.multiply(slope[..., 2, :], position, out=transposed[..., 2, :])
        return position * theta, np.swapaxes(transposed, -1, -2)

    def _powers(self, zeta: FloatArray) -> FloatArray:
        """Return e to the powers 0, 1, ..., degree, variable by variable, (..., 3 (degree + 1))."""
        powers = np.ones((*zeta.shape[:-1], 3, self.degree + 1))
        for power in range(1, self.degree + 1):
            np.multiply(powers[..., power - 1], zeta[..., :3], out=powers[..., power])
        return powers.reshape(*zeta.shape[:-1], -1)

    def quadratic_weights(self, matrix: FloatArray) -> FloatArray:
        """Return the weights of the value function e^T P e for P (..., 3, 3), shape (..., L)."""
        weights = np.zeros((*matrix.shape[:-2], len(self._exponents)))
        for term, (i, j) in enumerate(_PAIRS):
            weights[..., term] = matrix[..., i, j] * (1.0 if i == j else 2.0)
        return weights


class HalfAngleBasis:
    """Another basis, of the position error seen from half way between path and robot.

    The position error is turned by theta / 2: a = s cos(theta/2) + y sin(theta/2) and
    b = y cos(theta/2) - s sin(theta/2) take the places of s and y. Quadratic value functions of
    (a, b, theta) are much nearer to the optimal one, and stabilise from any heading.
    """

    def __init__(self, basis: Basis) -> None:
        """Take the basis whose s and y are to be a and b."""
        self._basis = basis

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the name of each term, length L, such as "a b" or "b² θ"."""
        return tuple(label.replace("s", "a").replace("y", "b") for label in self._basis.labels)

    @property
    def depends_on_path_state(self) -> bool:
        """Return whether phi is among the variables."""
        return self._basis.depends_on_path_state

    def value(self, zeta: FloatArray) -> FloatArray:
        """Return sigma at states of shape (..., 4), shape (..., L)."""
        return self._basis.value(half_angle_state(zeta))

    def gradient(self, zeta: FloatArray) -> FloatArray:
        """Return sigma' at states of shape (..., 4), shape (..., L, 4)."""
        return self.value_and_gradient(zeta)[1]

    def value_and_gradient(self, zeta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return sigma and sigma' at states of shape (..., 4)."""
        turned, cos, sin = _half_angle(zeta)
        value, inner = self._basis.value_and_gradient(turned)
        jacobian = np.zeros((*cos.shape, 4, 4))  # of (a, b, theta, phi) by (s, y, theta, phi), ...
        jacobian[..., 0, 0] = jacobian[..., 1, 1] = cos  # ... transposed, as what it multiplies
        jacobian[..., 1, 0], jacobian[..., 0, 1] = sin, -sin
        jacobian[..., 2, 0] = 0.5 * turned[..., 1]
        jacobian[..., 2, 1] = -0.5 * turned[..., 0]
        jacobian[..., 2, 2] = jacobian[..., 3, 3] = 1.0
        product = np.matmul(jacobian, np.swapaxes(inner, -1, -2))
        return value, np.swapaxes(product, -1, -2)

    def quadratic_weights(self, matrix: FloatArray) -> FloatArray:
        """Return the weights of e^T P e to second order for P (..., 3, 3), shape (..., L)."""
        return self._basis.quadratic_weights(matrix)


def half_angle_state(zeta: FloatArray) -> FloatArray:
    """Return states (..., 4) with a and b in the places of s and y, shape (..., 4)."""
    return _half_angle(zeta)[0]


def _half_angle(zeta: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the states with a and b for s and y, and cos and sin of half the heading error."""
    s, y, theta, _ = unpacked(zeta)
    half = 0.5 * theta
    cos, sin = np.cos(half), np.sin(half)
    turned = zeta.copy()
    turned[..., 0] = s * cos + y * sin
    turned[..., 1] = y * cos - s * sin
    return turned, cos, sin


_CROSS_TERMS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of the polynomial's quadratic terms
_SUPERSCRIPTS = str.maketrans("23456789", "²³⁴⁵⁶⁷⁸⁹")

BASES = ("paper", "paper_misprinted", "polynomial")
FRAMES = ("serret_frenet", "half_angle")


@functools.cache
def make_basis(name: str, degree: int, frame: str) -> Basis:
    """Return a basis by its name in `BASES`, in a frame of `FRAMES`.

    Args:
        name: "paper" is the paper's with its last three terms as squares (docs/paper.md, erratum
            1), "paper_misprinted" the one that is printed, to show that it leaves the path.
        degree: Highest degree of "polynomial".
        frame: The coordinates of the position error.

    """
    basis: Basis
    if name == "polynomial":
        basis = PolynomialBasis(degree)
    elif name == "paper":
        basis = QuadraticBasis(products=(*_CROSS_TERMS, (0, 0), (1, 1), (2, 2)))
    else:
        basis = QuadraticBasis(products=_CROSS_TERMS, singles=(0, 1, 2))
    return HalfAngleBasis(basis) if frame == "half_angle" else basis
