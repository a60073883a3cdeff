"""Bases of the value function: sigma(zeta) and its gradient sigma'(zeta)."""

import functools
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray, components, cos, numbers, sin
from adp_path_follower.core.registry import Registry

STATE_LABELS = ("s", "y", "θ", "φ")
Numbers = tuple[FloatArray, ...]  # of shape (...) each, or of one robot


@dataclass(frozen=True)
class HalfTurn:
    """The half-angle frame at states, numbers of shape (...) each."""

    a: FloatArray  # position error along the direction half way between path and robot [m]
    b: FloatArray  # position error across it [m]
    cos: FloatArray  # cosine of half the heading error
    sin: FloatArray  # sine of half the heading error

    def pulled_back(self, slope: Numbers) -> Numbers:
        """Return derivatives by (s, y, theta, ...) from those by (a, b, theta, ...)."""
        by_a, by_b, by_theta, *others = slope
        return (
            self.cos * by_a - self.sin * by_b,
            self.sin * by_a + self.cos * by_b,
            by_theta + 0.5 * (self.b * by_a - self.a * by_b),
            *others,
        )

    def pushed_forward(self, rate: Numbers) -> Numbers:
        """Return the rates of (a, b, theta, ...) from those of (s, y, theta, ...)."""
        s_rate, y_rate, turn, *others = rate
        return (
            self.cos * s_rate + self.sin * y_rate + 0.5 * self.b * turn,
            self.cos * y_rate - self.sin * s_rate - 0.5 * self.a * turn,
            turn,
            *others,
        )


@dataclass(frozen=True)
class Expansion:
    """sigma at states, and sigma' before the chain rule of the frame.

    At the robot only products of sigma' with weights and with rates are needed. Contracting before
    the chain rule is applied to three or four numbers, not to L rows of them.
    """

    value: FloatArray  # sigma, shape (..., L)
    # Derivatives by the basis's own V variables, shape (..., V, L): 3 without phi.
    partials: FloatArray
    frame: HalfTurn | None = None  # the frame of these variables, None if it is that of the states

    def slope(self, weights: FloatArray) -> Numbers:
        """Return W^T sigma' for weights (..., L): four numbers of shape (...)."""
        if self.partials.ndim == 2:
            slope = numbers(self.partials @ weights)
        else:
            slope = numbers(np.matmul(self.partials, weights[..., None])[..., 0])
        slope = (*slope, 0.0 * slope[0])[:4]
        return slope if self.frame is None else self.frame.pulled_back(slope)

    def rate(self, zeta_rate: Numbers) -> FloatArray:
        """Return sigma' zeta' for the rates of the four states, shape (..., L)."""
        own = zeta_rate if self.frame is None else self.frame.pushed_forward(zeta_rate)
        own_rate = components(*own[: self.partials.shape[-2]])
        if own_rate.ndim == 1:
            return np.asarray(own_rate @ self.partials)
        return np.asarray(np.matmul(own_rate[..., None, :], self.partials)[..., 0, :])

    @property
    def gradient(self) -> FloatArray:
        """Return sigma' written out, shape (..., L, 4)."""
        partials = np.swapaxes(self.partials, -1, -2)
        slope = tuple(partials[..., axis] for axis in range(partials.shape[-1]))
        slope = (*slope, np.zeros_like(slope[0]))[:4]
        if self.frame is not None:
            frame = HalfTurn(*(np.asarray(part)[..., None] for part in vars(self.frame).values()))
            slope = frame.pulled_back(slope)
        return components(*slope)


class Basis(ABC):
    """The interface of a basis for the learner."""

    labels: tuple[str, ...]  # name of each term, such as "s y" or "θ²", length L
    depends_on_path_state = False  # whether phi is among the variables

    @abstractmethod
    def expansion(self, zeta: FloatArray) -> Expansion:
        """Return sigma and the parts of sigma' at states of shape (..., 4)."""

    def value(self, zeta: FloatArray) -> FloatArray:
        """Return sigma at states of shape (..., 4), shape (..., L)."""
        return self.expansion(zeta).value

    def gradient(self, zeta: FloatArray) -> FloatArray:
        """Return sigma' at states of shape (..., 4), shape (..., L, 4)."""
        return self.expansion(zeta).gradient

    @abstractmethod
    def quadratic_weights(self, matrix: FloatArray) -> FloatArray:
        """Return the weights of e^T P e to second order for P (..., 3, 3), shape (..., L)."""


class QuadraticBasis(Basis):
    """A basis of products of two states, and of single states."""

    def __init__(
        self, products: tuple[tuple[int, int], ...], singles: tuple[int, ...] = ()
    ) -> None:
        """Take a pair (i, j) for each term zeta_i zeta_j, and an i for each single zeta_i."""
        names = STATE_LABELS
        squares = [f"{names[i]}²" if i == j else f"{names[i]} {names[j]}" for i, j in products]
        self.labels = (*squares, *(names[i] for i in singles))
        self.depends_on_path_state = any(3 in product for product in products) or 3 in singles
        self._products = products
        size, count = len(products) + len(singles), len(STATE_LABELS)
        self._slope = np.zeros((size, count, count))
        for term, (i, j) in enumerate(products):
            self._slope[term, i, j] += 1.0
            self._slope[term, j, i] += 1.0
        self._offset = np.zeros((size, count))
        for term, i in enumerate(singles, start=len(products)):
            self._offset[term, i] = 1.0
        # sigma' less its offset, variable by variable, is zeta times this.
        self._flat_slope = self._slope.transpose(2, 1, 0).reshape(count, count * size).copy()

    def expansion(self, zeta: FloatArray) -> Expansion:
        """Return sigma and the parts of sigma' at states of shape (..., 4)."""
        offset = self._offset.T
        slope = (zeta @ self._flat_slope).reshape(*zeta.shape[:-1], *offset.shape)
        value = np.matmul(zeta[..., None, :], 0.5 * slope + offset)[..., 0, :]
        return Expansion(value, slope + offset)

    def quadratic_weights(self, matrix: FloatArray) -> FloatArray:
        """Return the weights of the value function e^T P e for P (..., 3, 3), shape (..., L)."""
        pairs = [(term, pair) for term, pair in enumerate(self._products) if max(pair) < 3]
        return _weights_of_products(matrix, pairs, len(self.labels))


class PolynomialBasis(Basis):
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
        self.labels = tuple(
            " ".join(
                STATE_LABELS[axis] + ("" if power == 1 else str(power).translate(_SUPERSCRIPTS))
                for axis, power in enumerate(powers)
                if power
            )
            for powers in self._exponents.tolist()
        )
        # Where the factors of sigma and of its derivatives by s, y and theta, (4, L), stand in a
        # table of each variable's powers 0, 1, ... and of their derivatives.
        size = degree + 1
        self._factors = [
            2 * axis * size
            + self._exponents[:, axis]
            + size * (np.arange(4) == axis + 1).astype(int)[:, None]
            for axis in range(3)
        ]

    def expansion(self, zeta: FloatArray) -> Expansion:
        """Return sigma and the parts of sigma' at states of shape (..., 4)."""
        table = self._powers(zeta)
        together = table.take(self._factors[0], axis=-1)
        for factor in self._factors[1:]:
            together *= table.take(factor, axis=-1)
        return Expansion(together[..., 0, :], together[..., 1:, :])

    def _powers(self, zeta: FloatArray) -> FloatArray:
        """Return x^k and k x^(k - 1) for k = 0, 1, ... of s, y and theta, (..., 6 (degree + 1))."""
        if zeta.ndim == 1:
            table: list[float] = []
            for error in zeta.tolist()[:3]:
                powers = [1.0]
                for _ in range(self.degree):
                    powers.append(powers[-1] * error)
                table += powers
                table += [0.0, *(k * power for k, power in enumerate(powers[:-1], start=1))]
            return np.array(table)
        tables = np.ones((*zeta.shape[:-1], 3, 2, self.degree + 1))
        tables[..., 1, 0] = 0.0
        for k in range(1, self.degree + 1):
            lower = tables[..., 0, k - 1]
            np.multiply(lower, zeta[..., :3], out=tables[..., 0, k])
            np.multiply(lower, k, out=tables[..., 1, k])
        return tables.reshape(*zeta.shape[:-1], -1)

    def quadratic_weights(self, matrix: FloatArray) -> FloatArray:
        """Return the weights of the value function e^T P e for P (..., 3, 3), shape (..., L)."""
        return _weights_of_products(matrix, enumerate(PAIRS), len(self.labels))


class HalfAngleBasis(Basis):
    """Another basis, of the position error seen from half way between path and robot.

    The position error is turned by theta / 2: a = s cos(theta/2) + y sin(theta/2) and
    b = y cos(theta/2) - s sin(theta/2) take the places of s and y. Quadratic value functions of
    (a, b, theta) are much nearer to the optimal one, and stabilise from any heading.
    """

    def __init__(self, basis: Basis) -> None:
        """Take the basis whose s and y are to be a and b."""
        self._basis = basis
        self.labels = tuple(
            re.sub(r"(?<![a-z])[sy](?![a-z])", lambda found: "ab"[found[0] == "y"], label)
            for label in basis.labels
        )
        self.depends_on_path_state = basis.depends_on_path_state

    def expansion(self, zeta: FloatArray) -> Expansion:
        """Return sigma and the parts of sigma' at states of shape (..., 4)."""
        turned, frame = _half_angle(zeta)
        inner = self._basis.expansion(turned)
        return Expansion(inner.value, inner.partials, frame)

    def quadratic_weights(self, matrix: FloatArray) -> FloatArray:
        """Return the weights of e^T P e to second order for P (..., 3, 3), shape (..., L)."""
        return self._basis.quadratic_weights(matrix)


def _weights_of_products(
    matrix: FloatArray, pairs: Iterable[tuple[int, tuple[int, int]]], size: int
) -> FloatArray:
    """Return weights (..., L) of e^T P e for P (..., 3, 3), where terms are products e_i e_j."""
    weights = np.zeros((*matrix.shape[:-2], size))
    for term, (i, j) in pairs:
        weights[..., term] = matrix[..., i, j] * (1.0 if i == j else 2.0)
    return weights


def half_angle_state(zeta: FloatArray) -> FloatArray:
    """Return states (..., 4) with a and b in the places of s and y, shape (..., 4)."""
    return _half_angle(zeta)[0]


def _half_angle(zeta: FloatArray) -> tuple[FloatArray, HalfTurn]:
    """Return the states with a and b for s and y, and the frame of these."""
    s, y, theta, phi = numbers(zeta)
    half = 0.5 * theta
    ahead, aside = cos(half), sin(half)
    frame = HalfTurn(s * ahead + y * aside, y * ahead - s * aside, ahead, aside)
    return components(frame.a, frame.b, theta, phi), frame


_CROSS_TERMS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of the polynomial's quadratic terms
_SUPERSCRIPTS = str.maketrans("23456789", "²³⁴⁵⁶⁷⁸⁹")

BASES = ("paper", "paper_misprinted", "polynomial")
OWN_BASES: Registry[Callable[[], Basis]] = Registry("basis", BASES)  # of `register_basis`
FRAMES = ("serret_frenet", "half_angle")


@functools.cache
def make_basis(name: str, degree: int, frame: str) -> Basis:
    """Return a basis by its name in `BASES` or `OWN_BASES`, in a frame of `FRAMES`.

    "paper" has the last three terms as squares (erratum 1 of `adp docs method`);
    "paper_misprinted", as printed, leaves the path. `degree` is the highest one of "polynomial".
    """
    basis: Basis
    own = None if name in BASES else OWN_BASES.find(name)
    if own is not None:
        basis = own()
    elif name == "polynomial":
        basis = PolynomialBasis(degree)
    elif name == "paper":
        basis = QuadraticBasis(products=(*_CROSS_TERMS, (0, 0), (1, 1), (2, 2)))
    else:
        basis = QuadraticBasis(products=_CROSS_TERMS, singles=(0, 1, 2))
    return HalfAngleBasis(basis) if frame == "half_angle" else basis
