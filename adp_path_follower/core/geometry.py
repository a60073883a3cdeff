"""Angles and planar poses; every function broadcasts over leading axes."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Number = FloatArray | float  # of shape (...), or the same for all


def components(*parts: FloatArray) -> FloatArray:
    """Return arrays of one shape (...) side by side, shape (..., number of parts).

    Like `numpy.stack`, in a third of its time where the arrays are a robot's few numbers.
    """
    if isinstance(parts[0], float):
        return np.array(parts)
    together = np.empty((*parts[0].shape, len(parts)))
    for index, part in enumerate(parts):
        together[..., index] = part
    return together


def unpacked(array: FloatArray) -> tuple[FloatArray, ...]:
    """Return components along the last axis, each (...); of one vector numpy's fast scalars."""
    if array.ndim == 2:
        return tuple(array.T)  # the same views, in a third of the time
    return tuple(array[..., index][()] for index in range(array.shape[-1]))


def inner(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the inner products of vectors (..., L), shape (...)."""
    if first.ndim == second.ndim == 1:
        product: FloatArray = first.dot(second)
        return product
    return np.asarray((first * second).sum(-1))


def last_axis_sum(array: FloatArray) -> FloatArray:
    """Return the sums over a short last axis, for which numpy takes a hundred times as long."""
    return np.asarray(sum(array[..., axis] for axis in range(array.shape[-1])))


def contiguous(array: FloatArray) -> FloatArray:
    """Return a copy whose numbers lie side by side in memory; a single number as it is.

    numpy 1.26 computes arctan2, exp and the like of components, which lie apart, with another
    routine where the result happens to come right behind them in memory: two equal runs could
    differ in the last bit. A copy always, since numpy calls an array of one number contiguous
    whatever its stride.
    """
    return array if isinstance(array, float) else array.copy()


def numbers(array: FloatArray) -> tuple[FloatArray, ...]:
    """Return the components along the last axis, as `unpacked`, of one vector as Python's floats.

    Arithmetic with those is twice as fast as with numpy's scalars, and `cos` and the like are ten
    times as fast; but they raise where one divides by zero.
    """
    return tuple(array.tolist()) if array.ndim == 1 else unpacked(array)


def number(array: Any) -> Any:
    """Return an array, or the single number of one without axes as Python's float."""
    return array if np.ndim(array) else float(array)


def _of_one_or_many(
    one: Callable[[float], float], many: Callable[[FloatArray], FloatArray]
) -> Callable[[Number], FloatArray]:
    """Return a function of a single number, or of arrays of any shape."""

    def function(value: Any) -> Any:
        if not isinstance(value, float):
            return many(value)
        try:
            return one(value)
        except ValueError:  # of an infinite number
            return math.nan

    return function


cos = _of_one_or_many(math.cos, np.cos)
sin = _of_one_or_many(math.sin, np.sin)
tanh = _of_one_or_many(math.tanh, np.tanh)
log = _of_one_or_many(math.log, np.log)
asinh = _of_one_or_many(math.asinh, np.arcsinh)
# sin(x) / x: smooth through 0; numpy's is sin(pi x) / (pi x).
sinc = _of_one_or_many(
    lambda x: math.sin(x) / x if x else 1.0, lambda x: np.sinc(np.asarray(x) / math.pi)
)


def hypot(first: Any, second: Any) -> Any:
    """Return the length of a vector of two numbers, or of arrays of any shape."""
    return math.hypot(first, second) if isinstance(first, float) else np.hypot(first, second)


def clamped(value: Any, lowest: float, highest: float) -> Any:
    """Return a number, or an array of any shape, within bounds; NaN stays."""
    if isinstance(value, float):
        return min(max(value, lowest), highest)
    return np.minimum(np.maximum(value, lowest), highest)


def where(condition: Any, then: Any, otherwise: Any) -> Any:
    """Return one of two numbers, or `numpy.where` of arrays."""
    if isinstance(condition, np.ndarray):
        return np.where(condition, then, otherwise)
    return then if condition else otherwise


def anywhere(condition: Any) -> bool:
    """Return a condition, or whether that of an array is true somewhere."""
    return bool(condition.any()) if isinstance(condition, np.ndarray) else condition


def wrap_angle(angle: Number) -> FloatArray:
    """Return the angle [rad] wrapped to [-pi, pi), same shape."""
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    inside: FloatArray = where(wrapped >= math.pi, -math.pi, wrapped)  # rounding may reach pi
    return inside


def yaw_of_quaternion(x: float, y: float, z: float, w: float) -> float:
    """Return the heading [rad] of a rotation, given by a quaternion of any norm but zero."""
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def advance_pose(pose: FloatArray, linear: Number, angular: Number, dt: Number) -> FloatArray:
    """Return poses [x, y, theta] after a constant twist was held for a time, shape (..., 3).

    Exact for the unicycle x' = v cos(theta), y' = v sin(theta), theta' = w: the motion is an arc
    whose chord has the heading theta + w dt / 2 and the length v dt sinc(w dt / 2). The velocities
    v [m/s] and w [rad/s] have shape (...), dt [s] that too, or none.
    """
    half_turn, distance = angular * (0.5 * dt), linear * dt
    chord: FloatArray = np.multiply(distance, sinc(half_turn))
    x, y, theta = numbers(pose)
    middle = theta + half_turn
    return components(x + chord * cos(middle), y + chord * sin(middle), theta + 2.0 * half_turn)


def pose_in_frame(error: FloatArray, frame_pose: FloatArray) -> FloatArray:
    """Return the world pose (..., 3) of error [s, y, theta]; the inverse of `tracking_error`."""
    heading = frame_pose[..., 2]
    cos, sin = np.cos(heading), np.sin(heading)
    along, across = error[..., 0], error[..., 1]
    return components(
        frame_pose[..., 0] + cos * along - sin * across,
        frame_pose[..., 1] + sin * along + cos * across,
        heading + error[..., 2],
    )


def tracking_error(pose: FloatArray, frame_pose: FloatArray) -> FloatArray:
    """Return the error e = [s, y, theta] of a pose in the target's frame, shape (..., 3)."""
    x, y, robot_heading = numbers(pose)
    frame_x, frame_y, heading = numbers(frame_pose)
    dx, dy = x - frame_x, y - frame_y
    ahead, aside = cos(heading), sin(heading)
    theta = wrap_angle(robot_heading - heading)
    return components(ahead * dx + aside * dy, ahead * dy - aside * dx, theta)
