"""The optimum by its necessary conditions: an independent check of the collocation.

Pontryagin's principle gives a boundary value problem in the state and its costates. It is written
in the actual inputs [v, w], whose limits do not depend on the state, and takes curvature and speed
from the path itself; nothing is shared with the transcription but the guess.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_bvp

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.riccati import riccati_solution
from adp_path_follower.core.geometry import FloatArray, Number
from adp_path_follower.study.optimum.problem import Motion, OptimumError, Problem

_DIFFERENCE = 1e-4  # [m] to either side, of curvature and speed along the path


@dataclass(frozen=True)
class Extremal:
    """A solution of the necessary conditions."""

    cost: float  # J
    costates: FloatArray  # gradient of the value by s, y, theta, s_p at the start, shape (4,)


def solve_costates(problem: Problem, motion: Motion) -> Extremal:
    """Return the extremal near a motion, such as a collocation's, without limits of acceleration.

    Raises OptimumError if there is none.
    """
    if np.abs(motion.state[:, 2]).max() > np.pi:
        raise OptimumError(
            "no check by costates where the heading error passes pi, as the cost has a kink there: "
            "leave out --check"
        )
    start = motion.state[0]
    unknown = np.zeros((9, len(motion.time)))
    unknown[:4] = motion.state.T
    target = problem.settings.target
    terminal = riccati_solution(0.0, target.desired_speed, target, problem.settings.cost)
    unknown[4:7] = 2.0 * terminal @ motion.state[:, :3].T
    result = solve_bvp(
        lambda _, values: _rates(problem, values),
        lambda first, last: np.concatenate([first[:4] - start, last[4:8], first[8:]]),
        motion.time,
        unknown,
        tol=1e-6,
        max_nodes=50_000,
    )
    if not result.success:
        raise OptimumError(f"the costate problem was not solved: {result.message}")
    return Extremal(float(result.y[8, -1]), result.y[4:8, 0])


def _rates(problem: Problem, values: FloatArray) -> FloatArray:
    """Return the rates of state (4), costates (4) and cost, shape (9, T)."""
    s, y, theta, arc_length, *costates = values[:8]
    target = problem.settings.target
    gain = target.target_gain
    curvature, slope = _along_path(problem.path.curvature, arc_length)
    v_des, faster = _along_path(problem.reference.speed, arc_length)
    cos, sin = np.cos(theta), np.sin(theta)
    speed = v_des * cos + gain * s
    speeding = faster * cos  # change of the target's speed along the path
    feedforward = error_dynamics.feedforward(curvature, v_des).T
    along, across, turning, _ = costates
    # The minimiser of the Hamiltonian; clipped to the box, it is the constrained one (R diagonal).
    pull = np.stack([along * cos + across * sin, turning])
    limits = problem.settings.limits
    inputs = feedforward - 0.5 * np.linalg.solve(problem.input_cost, pull)
    inputs = np.clip(inputs, limits.lower[:, None], limits.upper[:, None])
    linear, angular = inputs
    modified = inputs - feedforward
    weighted = problem.input_cost @ modified
    error_weighted = problem.state_cost @ values[:3]
    rate = np.stack(
        [
            speed * (curvature * y - 1.0) + linear * cos,
            linear * sin - curvature * s * speed,
            angular - curvature * speed,
            speed,
        ]
    )
    # Partial derivatives of the rates by s, y, theta and s_p, at the inputs held.
    nothing = np.zeros_like(s)
    by_state = np.array(
        [
            [
                gain * (curvature * y - 1.0),
                speed * curvature,
                -v_des * sin * (curvature * y - 1.0) - linear * sin,
                slope * speed * y + speeding * (curvature * y - 1.0),
            ],
            [
                -curvature * (speed + s * gain),
                nothing,
                linear * cos + curvature * s * v_des * sin,
                -s * (slope * speed + curvature * speeding),
            ],
            [
                -curvature * gain,
                nothing,
                curvature * v_des * sin,
                -slope * speed - curvature * speeding,
            ],
            [gain + nothing, nothing, -v_des * sin, speeding],
        ]
    )
    turning_slope = slope * v_des + curvature * faster
    by_place = -2.0 * (weighted[0] * faster + weighted[1] * turning_slope)
    cost_slope = np.stack([*(2.0 * error_weighted), by_place])
    costate_rate = -cost_slope - np.einsum("ijt,it->jt", by_state, np.array(costates))
    cost = (values[:3] * error_weighted).sum(axis=0) + (modified * weighted).sum(axis=0)
    return np.vstack([rate, costate_rate, cost])


def _along_path(
    values: Callable[[FloatArray], Number], arc_length: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return values at arc lengths (T,) [m], and their change along the path, shape (T,) each."""
    ahead, behind = values(arc_length + _DIFFERENCE), values(arc_length - _DIFFERENCE)
    here = np.broadcast_to(values(arc_length), arc_length.shape)
    return here, here * 0.0 + (ahead - behind) / (2.0 * _DIFFERENCE)
