"""Bases of the value function: sigma(zeta) and its gradient sigma'(zeta)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from adp_path_follower.core.geometry import FloatArray

STATE_LABELS = ("s", "y", "θ", "φ")


class Basis(Protocol):
    """What the learner asks of a basis."""

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the name of each term, length L."""

    def value(self, zeta: FloatArray) -> FloatArray:
        """Return sigma at states of shape (..., 4), shape (..., L)."""

    def gradient(self, zeta: FloatArray) -> FloatArray:
        """Return sigma' at states of shape (..., 4), shape (..., L, 4)."""


@dataclass(frozen=True)
class QuadraticBasis:
    """A basis of products of two states, and of single states.

    Attributes:
        products: Index pairs (i, j), one for each term zeta_i zeta_j.
        singles: Indices i, one for each term zeta_i; they stand last.

    """

    products: tuple[tuple[int, int], ...]
    singles: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Prepare the constant arrays: sigma' is an affine map of zeta."""
        size, count = len(self.products) + len(self.singles), len(STATE_LABELS)
        slope = np.zeros((size, count, count))
        for term, (i, j) in enumerate(self.products):
            slope[term, i, j] += 1.0
            slope[term, j, i] += 1.0
        offset = np.zeros((size, count))
        for term, i in enumerate(self.singles, start=len(self.products)):
            offset[term, i] = 1.0
        object.__setattr__(self, "_slope", slope)
        object.__setattr__(self, "_flat_slope", slope.reshape(size * count, count).T.copy())
        object.__setattr__(self, "_offset", offset)

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the name of each term, length L, such as "s y" or "θ²"."""
        names = STATE_LABELS
        products = [
            f"{names[i]}²" if i == j else f"{names[i]} {names[j]}" for i, j in self.products
        ]
        return (*products, *(names[i] for i in self.singles))

    def value(self, zeta: FloatArray) -> FloatArray:
        """Return sigma at states of shape (..., 4), shape (..., L)."""
        slope: FloatArray = self._slope  # type: ignore[attr-defined]  # set in __post_init__
        offset: FloatArray = self._offset  # type: ignore[attr-defined]
        quadratic = 0.5 * np.einsum("...i,lij,...j->...l", zeta, slope, zeta)
        return np.asarray(quadratic + zeta @ offset.T)

    def gradient(self, zeta: FloatArray) -> FloatArray:
        """Return sigma' at states of shape (..., 4), shape (..., L, 4)."""
        flat: FloatArray = self._flat_slope  # type: ignore[attr-defined]
        offset: FloatArray = self._offset  # type: ignore[attr-defined]
        return (zeta @ flat).reshape(*zeta.shape[:-1], *offset.shape) + offset


_CROSS_TERMS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))

BASES: Mapping[str, Basis] = {
    # The paper's basis with its last three terms as squares (docs/paper.md, erratum 1).
    "paper": QuadraticBasis(products=(*_CROSS_TERMS, (0, 0), (1, 1), (2, 2))),
    # The basis as it is printed, to show that it leaves the path.
    "paper_misprinted": QuadraticBasis(products=_CROSS_TERMS, singles=(0, 1, 2)),
}
