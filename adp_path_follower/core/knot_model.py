"""Bellman errors at scattered sampled states, for weights that change along the path.

With V(e, s_p) = w(s_p)^T sigma(e), and w linear between knots a distance h apart, the Bellman
error of the knot at s_p is

    delta = e^T Q e + u^T R u + w^T omega + (w_ahead - w)^T sigma s_p' / h,
    omega = sigma'(e) (f(e, kappa) + g(e) u),

linear in the knot's weights w once those of the knot ahead are known. f is affine in the
curvature and in the speed v_des, so what is prepared once serves every knot of every path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpocon, dpotrf, dpotrs
from scipy.stats import qmc

from adp_path_follower.core import error_dynamics
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.policy import saturate
from adp_path_follower.core.settings import Settings

_INNER_SHARE = 0.3  # of the samples: scaled towards the origin, where the linear policy is decided
_INNERMOST = 0.05  # of the region: the smallest of these scales
_RIDGE = 1e-9  # on the normal equations' unit diagonal


@dataclass(frozen=True)
class NormalEquations:
    """Weighted sums over samples for min_w sum_j c_j (r_j + w^T x_j)^2.

    Attributes:
        matrix: sum_j c_j x_j x_j^T, shape (L, L).
        vector: sum_j c_j r_j x_j, shape (L,).
        offset: sum_j c_j r_j^2.
        running_cost: sum_j c_j (e^T Q e + u^T R u)^2, what the residual is compared with.

    """

    matrix: FloatArray
    vector: FloatArray
    offset: float
    running_cost: float

    def __add__(self, other: NormalEquations) -> NormalEquations:
        """Return the sums over the samples of both."""
        return NormalEquations(
            self.matrix + other.matrix,
            self.vector + other.vector,
            self.offset + other.offset,
            self.running_cost + other.running_cost,
        )


@dataclass(frozen=True)
class KnotFit:
    """The weights of one knot with the least Bellman errors.

    Attributes:
        critic_weights: Shape (L,); not finite where the samples do not determine them.
        residual: Root of the weighted mean square Bellman error over that of the running cost.
        excitation: The certificate: LAPACK's estimate of 1 / |M^-1|_1, M the rank condition's
            matrix scaled to a unit diagonal; the smallest singular value is hardly smaller.

    """

    critic_weights: FloatArray
    residual: float
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
    excitation, _ = dpocon(factor, 1.0, uplo="L")  # times the norm of M it would be 1 / cond(M)
    solution, _ = dpotrs(factor, -equations.vector * scale, lower=1)
    weights = solution * scale
    remaining = weights @ equations.matrix @ weights + 2.0 * weights @ equations.vector
    squared = max(float(remaining) + equations.offset, 0.0)
    return KnotFit(
        critic_weights=weights,
        residual=math.sqrt(squared / max(equations.running_cost, 1e-300)),
        excitation=float(excitation),
    )


@dataclass(frozen=True)
class _Drift:
    """What of the model depends on the speed along the path, for N samples.

    Attributes:
        straight: sigma' f at kappa = 0, shape (N, L).
        turning: Its change with kappa, shape (N, L).
        passing: sigma s_p' / h, shape (N, L).

    """

    straight: FloatArray
    turning: FloatArray
    passing: FloatArray


class KnotModel:
    """The model of the error dynamics at scattered sampled states."""

    def __init__(self, settings: Settings, spacing: float, varies: bool = False) -> None:
        """Prepare what depends neither on weights nor on curvature, at N samples.

        Args:
            settings: All settings.
            spacing: Distance h between knots [m].
            varies: Whether knots have speeds of their own.

        """
        learning = settings.learning
        self.states = scattered_samples(
            learning.sample_count, learning.sample_half_widths[:3], learning.sample_seed
        )
        zeta = np.column_stack([self.states, np.zeros(len(self.states))])
        basis, target = learning.value_basis, settings.target
        gradient, value = basis.gradient(zeta), basis.value(zeta)

        def drift(v_des: float) -> _Drift:
            nowhere, fast = np.zeros(len(zeta)), np.full(len(zeta), v_des)
            straight = error_dynamics.drift(zeta, nowhere, target, fast)
            turning = error_dynamics.drift(zeta, nowhere + 1.0, target, fast) - straight
            speed = error_dynamics.target_speed(zeta, target, fast)
            return _Drift(
                np.einsum("nlz,nz->nl", gradient, straight),
                np.einsum("nlz,nz->nl", gradient, turning),
                value * speed[:, None] / spacing,
            )

        self._drift = drift(target.desired_speed)
        if varies:  # it is affine in v_des
            self._still, fast = drift(0.0), drift(1.0)
            self._by_speed = _Drift(
                fast.straight - self._still.straight,
                fast.turning - self._still.turning,
                fast.passing - self._still.passing,
            )
        input_gradient = np.matmul(gradient, error_dynamics.input_matrix(zeta))
        self._linear = np.ascontiguousarray(input_gradient[..., 0])  # sigma' g, (N, L) each
        self._angular = np.ascontiguousarray(input_gradient[..., 1])
        self._target, self._limits = target, settings.limits
        self._input_cost = settings.cost.input_cost_matrix()
        self._half_inverse = -0.5 * np.linalg.inv(self._input_cost)
        self._state_cost = np.einsum(
            "ni,ij,nj->n", self.states, settings.cost.state_cost_matrix(), self.states
        )
        # V grows with the square of the distance: relative errors count alike at any distance.
        radius = np.linalg.norm(self.states / learning.sample_half_widths[:3], axis=1)
        self._importance = radius**-4.0

    def __len__(self) -> int:
        """Return the number of samples N."""
        return len(self.states)

    def equations(
        self,
        samples: slice,
        ahead: FloatArray,
        curvature: float,
        v_des: float | None = None,
    ) -> NormalEquations:
        """Return the normal equations of a knot's critic weights over some of the samples.

        Args:
            samples: Which samples.
            ahead: Wc of the knot ahead, whose policy is evaluated, shape (L,).
            curvature: kappa [1/m] of the path at the knot.
            v_des: Speed [m/s] there, if it is another than `desired_speed`.

        """
        linear, angular = self._linear[samples], self._angular[samples]
        # One input after the other in memory: the operations on all samples then are fast.
        inputs = (self._half_inverse @ np.array([linear @ ahead, angular @ ahead])).T
        if not self._limits.unlimited:
            speed = None if v_des is None else np.asarray(v_des)
            feedforward = error_dynamics.feedforward(np.asarray(curvature), self._target, speed)
            inputs = saturate(inputs, feedforward, self._limits)
        regressor, passing = self._drift_at(samples, curvature, v_des)
        regressor += inputs[:, :1] * linear
        regressor += inputs[:, 1:] * angular
        importance = self._importance[samples] / (1.0 + np.einsum("nl,nl->n", regressor, regressor))
        running_cost = self._state_cost[samples] + (inputs @ self._input_cost * inputs).sum(axis=1)
        constant = running_cost + passing @ ahead
        regressor -= passing
        root = np.sqrt(importance)
        weighted = regressor * root[:, None]
        return NormalEquations(
            matrix=weighted.T @ weighted,  # numpy sees the symmetry, and does half the work
            vector=(root * constant) @ weighted,
            offset=float(importance @ (constant * constant)),
            running_cost=float(importance @ (running_cost * running_cost)),
        )

    def _drift_at(
        self, samples: slice, curvature: float, v_des: float | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return sigma' f and sigma s_p' / h of some samples at a knot, shape (n, L) each."""
        if v_des is None:
            drift = self._drift
            regressor = drift.straight[samples] + curvature * drift.turning[samples]
            return regressor, drift.passing[samples]
        still, moving = self._still, self._by_speed
        regressor = still.straight[samples] + curvature * still.turning[samples]
        regressor += v_des * moving.straight[samples]
        regressor += (v_des * curvature) * moving.turning[samples]
        return regressor, still.passing[samples] + v_des * moving.passing[samples]


def scattered_samples(count: int, half_widths: tuple[float, ...], seed: int) -> FloatArray:
    """Return states e scattered over a box about the origin, shape (count, 3).

    A scrambled Sobol sequence, of which a share is scaled towards the origin.
    """
    points = qmc.Sobol(4, seed=seed).random(2 ** math.ceil(math.log2(count)))[:count]
    inner = points[:, 3] / _INNER_SHARE
    scale = np.where(inner < 1.0, _INNERMOST**inner, 1.0)
    return np.asarray((2.0 * points[:, :3] - 1.0) * half_widths * scale[:, None])
