"""Value bases of a user's own: terms of the error e = [s, y, theta] and their slopes."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from adp_path_follower.core.basis import OWN_BASES, PAIRS, Basis, Expansion, make_basis
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray

_MEMBERS = ("labels", "value", "gradient")
_PAIR_NAMES = ("s²", "s y", "s θ", "y²", "y θ", "θ²")
_STEP = 1e-5  # of the differences that gradients are compared with


class ValueBasis(Protocol):
    """The terms sigma of a value function V = W^T sigma(e), for errors e = [s, y, theta].

    In `frame: half_angle`, s and y are the position error turned by half the heading error.
    """

    @property
    def labels(self) -> tuple[str, ...]:
        """Return the name of each of the L terms."""

    def value(self, error: FloatArray) -> FloatArray:
        """Return sigma at errors of shape (..., 3), shape (..., L)."""

    def gradient(self, error: FloatArray) -> FloatArray:
        """Return the derivatives of sigma by s, y and theta, shape (..., L, 3)."""


def register_basis(name: str, factory: Callable[[], ValueBasis]) -> None:
    """Register a value basis, so that `basis: NAME` chooses it in YAML and everywhere else.

    Example: `adp.register_basis("bounded", BoundedBasis)`, then
    `adp.load_settings("default", basis="bounded")`; examples/own_basis.py has all of it.

    Args:
        name: Letters, digits and _.
        factory: Makes the basis; its class will do.

    Raises:
        AdpError: Something of `ValueBasis` is missing, has the wrong shape, or does not fit the
            rest; or the name is taken by the package.

    """

    def make() -> _OwnBasis:
        return _OwnBasis(name, factory())

    make()
    OWN_BASES.register(name, make)
    make_basis.cache_clear()


class _OwnBasis(Basis):
    """A user's basis as the learner sees it: without phi."""

    def __init__(self, name: str, basis: ValueBasis) -> None:
        """Check the basis; see `register_basis`."""
        for member in _MEMBERS:
            if not hasattr(basis, member):
                raise AdpError(
                    f"basis '{name}' has no '{member}': it needs labels, value(error) and "
                    "gradient(error)"
                )
        self._basis = basis
        self.labels = tuple(basis.labels)
        if len({*map(str, self.labels)}) != len(self.labels) or not self.labels:
            raise AdpError(f"basis '{name}' has the labels {self.labels}, but they must differ")
        _check_shapes(name, basis, len(self.labels))
        _check_slopes(name, basis, self.labels)
        self._quadratic = _quadratic_part(name, basis)

    def expansion(self, zeta: FloatArray) -> Expansion:
        value = np.asarray(self._basis.value(zeta[..., :3]), float)
        slopes = np.asarray(self._basis.gradient(zeta[..., :3]), float)
        return Expansion(value, np.ascontiguousarray(np.swapaxes(slopes, -1, -2)))

    def quadratic_weights(self, matrix: FloatArray) -> FloatArray:
        """Return the least weights of e^T P e to second order for P (..., 3, 3), (..., L)."""
        wanted = np.stack([matrix[..., i, j] * (1.0 if i == j else 2.0) for i, j in PAIRS], axis=-1)
        return np.asarray(wanted @ self._quadratic)


def _check_shapes(name: str, basis: ValueBasis, count: int) -> None:
    for leading in ((), (5,), (2, 4)):
        error = np.full((*leading, 3), 0.1)
        for member, shape in (("value", (*leading, count)), ("gradient", (*leading, count, 3))):
            found = np.asarray(getattr(basis, member)(error))
            if found.shape != shape or not np.isfinite(found.astype(float)).all():
                raise AdpError(
                    f"basis '{name}': {member} of errors of shape {error.shape} has shape "
                    f"{found.shape}, but must be finite and of shape {shape}: one for each label"
                )


def _check_slopes(name: str, basis: ValueBasis, labels: tuple[str, ...]) -> None:
    """Compare the gradient with differences of the values, and require none at the path."""
    errors = np.random.default_rng(0).uniform(-0.7, 0.7, (20, 3))
    found = basis.gradient(errors)
    for axis in range(3):
        step = _STEP * np.eye(3)[axis]
        slope = (basis.value(errors + step) - basis.value(errors - step)) / (2.0 * _STEP)
        wrong = np.abs(slope - found[..., axis]) > 1e-5 * (1.0 + np.abs(slope))
        if wrong.any():
            term = labels[int(np.argmax(wrong.any(axis=0)))]
            raise AdpError(
                f"basis '{name}': gradient of the term '{term}' is not that of its value"
            )
    steep = np.abs(basis.gradient(np.zeros(3))).max(axis=-1) > 1e-9
    if steep.any():
        raise AdpError(
            f"basis '{name}': the term '{labels[int(np.argmax(steep))]}' has a slope where the "
            "error is zero, so that a robot would leave the path: take its square, for example"
        )


def _quadratic_part(name: str, basis: ValueBasis) -> FloatArray:
    """Return the weights that make s², s y, s θ, y², y θ and θ² near the path, shape (6, L)."""
    steps = _STEP * np.eye(3)
    curvature = (basis.gradient(steps) - basis.gradient(-steps)) / (2.0 * _STEP)  # (3, L, 3)
    terms = np.stack(
        [curvature[i, :, j] * (0.5 if i == j else 1.0) for i, j in PAIRS], axis=-1
    )  # (L, 6): how much of each product a term is
    weights = np.linalg.pinv(terms, rcond=1e-6)
    missing = np.abs(weights @ terms - np.eye(6)).max(axis=1) > 1e-6
    if missing.any():
        product = _PAIR_NAMES[int(np.argmax(missing))]
        raise AdpError(
            f"basis '{name}': no sum of its terms is {product} near the path, which the value "
            "function needs: add a term"
        )
    return np.asarray(np.where(np.abs(weights) < 1e-9, 0.0, weights))
