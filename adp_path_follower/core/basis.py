"""Bases of the value function: sigma(zeta) and its gradient sigma'(zeta)."""

import functools
import itertools
import operator
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
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
            slope = numbers(self.partials.dot(weights))
        else:
            slope = numbers(np.matmul(self.partials, weights[..., None])[..., 0])
        slope = (*slope, 0.0 * slope[0])[:4]
        return slope if self.frame is None else self.frame.pulled_back(slope)

    def rate(self, zeta_rate: Numbers) -> FloatArray:
        """Return sigma' zeta' for the rates of the four states, shape (..., L)."""
        own = zeta_rate if self.frame is None else self.frame.pushed_forward(zeta_rate)
        own_rate = components(*own[: self.partials.shape[-2]])
        if own_rate.ndim == 1:
            return np.asarray(own_rate.dot(self.partials))
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


class MonomialBasis(Basis):
    """A basis of products of powers of the states."""

    def __init__(self, exponents: Iterable[Sequence[int]]) -> None:
        """Take the powers of s, y and theta, and perhaps of phi, of each of L terms."""
        powers = np.array(list(exponents))
        self.labels = tuple(
            " ".join(
                STATE_LABELS[axis] + ("" if power == 1 else str(power).translate(_SUPERSCRIPTS))
                for axis, power in enumerate(row)
                if power
            )
            for row in powers.tolist()
        )
        variables = powers.shape[1]
        self.depends_on_path_state = variables > 3
        self._pairs = [  # of each term e_i e_j: its number, i and j
            (term, *np.repeat(range(variables), row).tolist())
            for term, row in enumerate(powers)
            if row.sum() == row[:3].sum() == 2
        ]
        # Where the factors of sigma and of its derivatives stand in a table of the powers 0, 1, ...
        # of each of V variables and of their derivatives.
        size = self._size = int(powers.max()) + 1
        axes = np.arange(variables)[:, None, None]
        slopes = np.arange(1 + variables)[:, None] == axes + 1
        self._factors = size * (2 * axes + slopes) + powers.T[:, None]  # (V, 1 + V, L)

    def expansion(self, zeta: FloatArray) -> Expansion:
        """Return sigma and the parts of sigma' at states of shape (..., 4)."""
        table = self._powers(zeta)
        together = table.take(self._factors[0], axis=-1)
        for factor in self._factors[1:]:  # all at once would not fit into the caches
            together *= table.take(factor, axis=-1)
        return Expansion(together[..., 0, :], together[..., 1:, :])

    def _powers(self, zeta: FloatArray) -> FloatArray:
        """Return x^k and k x^(k - 1) for k = 0, 1, ... of each variable, (..., 2 V size)."""
        variables = len(self._factors)
        if zeta.ndim == 1:
            table: list[float] = []
            for state in zeta.tolist()[:variables]:
                powers = [1.0]
                for _ in range(1, self._size):
                    powers.append(powers[-1] * state)
                table += powers
                table.append(0.0)
                table += map(operator.mul, range(1, self._size), powers)
            return np.array(table)
        tables = np.ones((*zeta.shape[:-1], variables, 2, self._size))
        tables[..., 1, 0] = 0.0
        for k in range(1, self._size):
            lower = tables[..., 0, k - 1]
            np.multiply(lower, zeta[..., :variables], out=tables[..., 0, k])
            np.multiply(lower, k, out=tables[..., 1, k])
        return tables.reshape(*zeta.shape[:-1], -1)

    def quadratic_weights(self, matrix: FloatArray) -> FloatArray:
        """Return the weights of the value function e^T P e for P (..., 3, 3), shape (..., L)."""
        weights = np.zeros((*matrix.shape[:-2], len(self.labels)))
        for term, i, j in self._pairs:
            weights[..., term] = matrix[..., i, j] * (1.0 if i == j else 2.0)
        return weights


class PolynomialBasis(MonomialBasis):
    """All monomials of the error e = [s, y, theta] from degree 2 to a highest degree."""

    def __init__(self, degree: int) -> None:
        """Take the terms by rising degree: the quadratic ones come first."""
        super().__init__(
            (i, j, total - i - j)
            for total in range(2, degree + 1)
            for i in range(total, -1, -1)
            for j in range(total - i, -1, -1)
        )


class HalfAngleBasis(Basis):
    """Another basis, of the position error seen from half way between path and robot.

    The position error is turned by theta / 2: a = s cos(theta/2) + y sin(theta/2) and
    b = y cos(theta/2) - s sin(theta/2) take the places of s and y. Quadratic value functions of
    (a, b, theta) are much nearer to the optimal one, and stabilise from any heading.
    """

    def __init__(self, basis: Basis) -> None:
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


_UNITS = np.eye(4, dtype=int)
_CROSS_TERMS = [_UNITS[i] + _UNITS[j] for i, j in itertools.combinations(range(4), 2)]
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
        basis = MonomialBasis([*_CROSS_TERMS, *2 * _UNITS[:3]])
    else:
        basis = MonomialBasis([*_CROSS_TERMS, *_UNITS[:3]])
    return HalfAngleBasis(basis) if frame == "half_angle" else basis
