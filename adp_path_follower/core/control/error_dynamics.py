"""The vehicle's error in the frame of a virtual target, and how it moves (paper, section II).

The state is zeta = [s, y, theta, phi]: the position error along the tangent [m] and the normal
[m] of the path, the heading error [rad], and the compact path state phi = tanh(k2 s_p). Every
function broadcasts over leading axes. v_des is the speed along the path [m/s] at each state's
place, of shape (...), or one number for all.
"""

import numpy as np

from adp_path_follower.core.geometry import (
    FloatArray,
    Number,
    components,
    contiguous,
    cos,
    numbers,
    sin,
    tanh,
)
from adp_path_follower.core.settings.groups import TargetSettings


def target_speed(error: FloatArray, target: TargetSettings, v_des: Number) -> FloatArray:
    """Return the virtual target's speed s_p' = v_des cos(theta) + k1 s [m/s], shape (...)."""
    along, _, theta, *_ = numbers(error)
    return v_des * cos(theta) + target.target_gain * along


def path_state(arc_length: FloatArray, target: TargetSettings) -> FloatArray:
    """Return the compact path state phi = tanh(k2 s_p), same shape."""
    return tanh(target.path_state_gain * arc_length)


def arc_length_of(phi: FloatArray, target: TargetSettings) -> FloatArray:
    """Return the arc length s_p [m] of a compact path state, same shape."""
    return np.asarray(np.arctanh(contiguous(phi)) / target.path_state_gain)


def feedforward(curvature: FloatArray, v_des: Number) -> FloatArray:
    """Return the input that keeps a robot on the path, [v_ss, w_ss] = v_des [1, kappa]."""
    if not isinstance(curvature, float):
        v_des = np.full_like(curvature, v_des)
    return components(v_des, v_des * curvature)


def error_rates(
    error: tuple[Number, ...], curvature: FloatArray, speed: Number, v_des: Number
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return s', y' and theta' of f, (...) each, for s, y and theta, kappa [1/m] and s_p' [m/s]."""
    s, y, theta = error
    # With s_p' in one piece these are the printed terms: v_des cos(theta) cancels in s'.
    return (
        speed * (curvature * y - 1.0) + v_des * cos(theta),
        v_des * sin(theta) - curvature * s * speed,
        curvature * (v_des - speed),
    )


def drift(
    zeta: FloatArray, curvature: FloatArray, target: TargetSettings, v_des: Number
) -> FloatArray:
    """Return f of zeta' = f(zeta) + g(zeta) u at states (..., 4), kappa [1/m] and v_des [m/s]."""
    s, y, theta, phi = numbers(zeta)
    speed = target_speed(zeta, target, v_des)
    rates = error_rates((s, y, theta), curvature, speed, v_des)
    return components(*rates, target.path_state_gain * (1.0 - phi * phi) * speed)


def input_matrix(zeta: FloatArray) -> FloatArray:
    """Return g of zeta' = f(zeta) + g(zeta) u, shape (..., 4, 2)."""
    theta = zeta[..., 2]
    matrix = np.zeros((*theta.shape, 4, 2))
    matrix[..., 0, 0] = np.cos(theta)
    matrix[..., 1, 0] = np.sin(theta)
    matrix[..., 2, 1] = 1.0
    return matrix
