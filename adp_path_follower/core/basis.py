"""Bases of the value function: sigma(zeta) and its gradient sigma'(zeta)."""

from __future__ import annotations

from collections.abc import Mapping
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


_CROSS_TERMS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))

BASES: Mapping[str, Basis] = {
    # The paper's basis with its last three terms as squares (docs/paper.md, erratum 1).
    "paper": QuadraticBasis(products=(*_CROSS_TERMS, (0, 0), (1, 1), (2, 2))),
    # The basis as it is printed, to show that it leaves the path.
    "paper_misprinted": QuadraticBasis(products=_CROSS_TERMS, singles=(0, 1, 2)),
}
