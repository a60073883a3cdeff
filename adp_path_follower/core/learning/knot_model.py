"""Bellman errors at scattered sampled states, for weights that change along the path.

With V(e, s_p) = w(s_p)^T sigma(e), and w linear between knots h apart, that of the knot at s_p is

    delta = e^T Q e + u^T R u + w^T omega + (w_ahead - w)^T sigma s_p' / h,
    omega = sigma'(e) (f(e, kappa) + g(e) u).

f is affine in kappa and v_des, so what is prepared once serves every knot of every path.
"""

import functools
import math
import operator
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpocon, dpotrf, dpotrs

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.samples import scattered_samples
from adp_path_follower.core.settings.groups import Settings

_RIDGE = 1e-9  # on the normal equations' unit diagonal


@dataclass(frozen=True)
class NormalEquations:
    """Weighted sums over samples for min_w sum_j c_j (r_j + w^T x_j)^2."""

    matrix: FloatArray  # sum_j c_j x_j x_j^T, shape (L, L)
    vector: FloatArray  # sum_j c_j r_j x_j, shape (L,)
    offset: float  # sum_j c_j r_j^2
    running_cost: float  # sum_j c_j (e^T Q e + u^T R u)^2, the residual's measure

    def __add__(self, other: "NormalEquations") -> "NormalEquations":
        """Return the sums over the samples of both."""
        return NormalEquations(*map(operator.add, vars(self).values(), vars(other).values()))


@dataclass(frozen=True)
class KnotFit:
    """The weights of one knot with the least Bellman errors."""

    critic_weights: FloatArray  # shape (L,); not finite where the samples do not determine them
    residual: float  # root of the weighted mean square Bellman error over that of the running cost
    # The certificate: LAPACK's estimate of 1 / |M^-1|_1, M the rank condition's matrix scaled to a
    # unit diagonal; the smallest singular value is hardly smaller.
    excitation: float


def fit(equations: NormalEquations) -> KnotFit:
    """Return the solution of the normal equations, by Cholesky's method."""
    scale = 1.0 / np.sqrt(np.maximum(equations.matrix.diagonal(), 1e-300))
    scaled = equations.matrix * scale[:, None]
    scaled *= scale
    scaled.ravel()[:: len(scale) + 1] += _RIDGE  # the diagonal
    factor, failed = dpotrf(scaled, lower=1)
    if failed or not math.isfinite(float(factor.sum())):
        return KnotFit(np.full(len(scale), np.nan), math.inf, 0.0)
    excitation, _ = dpocon(factor, 1.0, uplo="L")  # with the norm of M, its condition
    solution, _ = dpotrs(factor, -equations.vector * scale, lower=1)
    weights = solution * scale
    remaining = weights @ equations.matrix @ weights + 2.0 * weights @ equations.vector
    squared = max(float(remaining) + equations.offset, 0.0)
    return KnotFit(
        critic_weights=weights,
        residual=math.sqrt(squared / max(equations.running_cost, 1e-300)),
        excitation=float(excitation),
    )


class KnotModel:
    """The model of the error dynamics at scattered sampled states."""

    def __init__(self, settings: Settings, spacing: float, varies: bool = False) -> None:
        """Prepare N samples for knots h [m] apart; `varies`: these have speeds of their own."""
        learning = settings.learning
        widths = settings.half_widths
        self.states = scattered_samples(learning.sample_count, widths, learning.sample_seed)
        self._desired_speed, self._varies = settings.target.desired_speed, varies
        self._limits = settings.limits
        self._lowest, self._highest = (
            bound[:, None] for bound in (self._limits.lower, self._limits.upper)
        )
        # The terms of regressors at each sample, (N, K, L): one product of small matrices for each
        # sample takes a third of the time of operations on whole arrays.
        self._terms = _terms(self.states, settings, spacing, varies)
        products = np.matmul(self._terms, np.swapaxes(self._terms, 1, 2))  # (N, K, K)
        kinds = 4 if varies else 2  # of the drift
        self._drift_products = products[:, 2 : 2 + kinds, 2 : 2 + kinds].reshape(-1, kinds**2)
        self._mixed_products = 2.0 * np.swapaxes(products[:, :2, 2 : 2 + kinds], 0, 1)
        self._input_products = np.array(
            [products[:, 0, 0], 2.0 * products[:, 0, 1], products[:, 1, 1]]
        )
        cost = settings.cost.input_cost_matrix()
        self._input_cost = cost[0, 0], cost[0, 1] + cost[1, 0], cost[1, 1]
        self._half_inverse = -0.5 * np.linalg.inv(cost)
        self._state_cost = np.einsum(
            "ni,ij,nj->n", self.states, settings.cost.state_cost_matrix(), self.states
        )
        # V grows with the square of the distance: relative errors count alike at any distance.
        radius = np.linalg.norm(self.states / widths, axis=1)
        self._importance = radius**-4.0

    def __len__(self) -> int:
        """Return the number of samples N."""
        return len(self.states)

    def equations(
        self, samples: slice, ahead: FloatArray, curvature: float, v_des: float
    ) -> NormalEquations:
        """Return the normal equations of a knot's critic weights over some of the samples.

        `ahead` is Wc of the knot ahead, whose policy is evaluated, shape (L,). kappa [1/m] and
        v_des [m/s] are those at the knot; a model whose knots share one speed has that.
        """
        terms = self._terms[samples]
        count, kinds, size = terms.shape
        by_speed = np.array([1.0, v_des] if self._varies else [1.0])
        drift = np.multiply.outer(by_speed, [1.0, curvature]).ravel()
        forward = (terms.reshape(-1, size) @ ahead).reshape(count, kinds).T  # of the knot ahead
        inputs = self._half_inverse @ forward[:2]
        if not self._limits.unlimited:
            speed = v_des if self._varies else self._desired_speed
            feedforward = np.array([[speed], [speed * curvature]])
            inputs = np.maximum(inputs, self._lowest - feedforward)
            inputs = np.minimum(inputs, self._highest - feedforward)
        squared_norm = _quadratic(
            self._input_products[:, samples],
            inputs,
            self._drift_products[samples] @ np.multiply.outer(drift, drift).ravel(),
            self._mixed_products[:, samples] @ drift,
        )
        importance = self._importance[samples] / (1.0 + squared_norm)
        running_cost = _quadratic(self._input_cost, inputs, self._state_cost[samples])
        constant = running_cost + by_speed @ forward[-len(by_speed) :]
        root = np.sqrt(importance)
        shares = np.empty((kinds, count))  # of each term in the regressor less sigma s_p' / h
        shares[:2], shares[2:] = inputs, np.concatenate([drift, -by_speed])[:, None]
        shares *= root
        weighted = np.matmul(np.ascontiguousarray(shares.T)[:, None], terms)[:, 0]
        return NormalEquations(
            matrix=weighted.T @ weighted,  # numpy sees the symmetry, and does half the work
            vector=(root * constant) @ weighted,
            offset=float(importance @ (constant * constant)),
            running_cost=float(importance @ (running_cost * running_cost)),
        )


@functools.lru_cache(4)
def knot_model(settings: Settings, spacing: float, varies: bool) -> KnotModel:
    """Return a `KnotModel`, made once for paths that come one after the other while driving."""
    return KnotModel(settings, spacing, varies)


def _quadratic(
    coefficients: Iterable[FloatArray],
    inputs: FloatArray,
    constant: FloatArray,
    slope: FloatArray | None = None,
) -> FloatArray:
    """Return c + b_v v + b_w w + a_vv v^2 + a_vw v w + a_ww w^2, (n,) of inputs (2, n)."""
    v, w = inputs
    both, mixed, last = coefficients
    along, across = both * v + mixed * w, last * w
    if slope is not None:
        along, across = along + slope[0], across + slope[1]
    return np.asarray(constant + along * v + across * w)


def _terms(states: FloatArray, settings: Settings, spacing: float, varies: bool) -> FloatArray:
    """Return the terms of regressors at states (N, 3), shape (N, K, L).

    Both columns of sigma' g; sigma' f at kappa = 0, and its change with kappa; sigma s_p' / h.
    Where v_des varies, all but the first two at v_des = 0, each kind followed by its change with
    v_des.
    """
    zeta = np.column_stack([states, np.zeros(len(states))])
    basis, target = settings.learning.value_basis, settings.target
    gradient, value = basis.gradient(zeta), basis.value(zeta)

    def drift(v_des: float) -> tuple[FloatArray, FloatArray]:
        nowhere, fast = np.zeros(len(zeta)), np.full(len(zeta), v_des)
        straight = error_dynamics.drift(zeta, nowhere, target, fast)
        turning = error_dynamics.drift(zeta, nowhere + 1.0, target, fast) - straight
        speed = error_dynamics.target_speed(zeta, target, fast)
        both = np.matmul(gradient, np.stack([straight, turning], axis=-1))
        return both, (value * speed[:, None] / spacing)[..., None]

    kinds = [np.matmul(gradient, error_dynamics.input_matrix(zeta))]
    if varies:  # both are affine in v_des
        still, moving = drift(0.0), drift(1.0)
        for at_rest, fast in zip(still, moving, strict=True):
            kinds += [at_rest, fast - at_rest]
    else:
        kinds += drift(target.desired_speed)
    return np.ascontiguousarray(np.swapaxes(np.concatenate(kinds, axis=-1), 1, 2))
