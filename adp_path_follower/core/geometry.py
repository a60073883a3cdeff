"""Angles and planar poses; every function broadcasts over leading axes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


def components(*parts: FloatArray) -> FloatArray:
    """Return arrays of one shape (...) side by side, shape (..., number of parts).

    What `numpy.stack` does, in a third of its time where the arrays are a robot's few numbers.
    """
    together = np.empty((*parts[0].shape, len(parts)))
    for index, part in enumerate(parts):
        together[..., index] = part
    return together


def unpacked(array: FloatArray) -> tuple[FloatArray, ...]:
    """Return the components along the last axis of an array, each of shape (...).

    Of a single vector they are numpy's scalars, which are several times faster to compute with
    than the arrays without dimensions that indexing by an ellipsis gives.
    """
    return tuple(array[..., index][()] for index in range(array.shape[-1]))


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """Return the angle [rad] wrapped to [-pi, pi), same shape."""
    wrapped = (np.asarray(angle)[()] + math.pi) % (2.0 * math.pi) - math.pi
    return np.asarray(np.where(wrapped < math.pi, wrapped, -math.pi))  # rounding may reach pi


def yaw_of_quaternion(x: float, y: float, z: float, w: float) -> float:
    """Return the heading [rad] of a rotation, given by a quaternion of any norm but zero."""
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


def advance_pose(pose: FloatArray, linear: ArrayLike, angular: ArrayLike, dt: float) -> FloatArray:
    """Return the pose after a constant twist was held for a time, shape (..., 3).

    Exact for the unicycle x' = v cos(theta), y' = v sin(theta), theta' = w: the motion is an arc
    whose chord has the heading theta + w dt / 2 and the length v dt sinc(w dt / 2).

    Args:
        pose: x [m], y [m], theta [rad], shape (..., 3).
        linear: Linear velocity v [m/s], shape (...).
        angular: Angular velocity w [rad/s], shape (...).
        dt: Duration [s].

    """
    half_turn = np.asarray(angular) * (0.5 * dt)
    # numpy's sinc is sin(pi x)/(pi x): smooth through w = 0, where an arc becomes a line.
    chord = np.asarray(linear) * dt * np.sinc(half_turn / math.pi)
    x, y, theta = unpacked(pose)
    middle = theta + half_turn
    return components(
        x + chord * np.cos(middle), y + chord * np.sin(middle), theta + 2.0 * half_turn
    )


def pose_in_frame(error: FloatArray, frame_pose: FloatArray) -> FloatArray:
    """Return the world pose of a vehicle with error [s, y, theta] in a frame, shape (..., 3).

    The inverse of `error_dynamics.tracking_error`.
    """
    heading = frame_pose[..., 2]
    cos, sin = np.cos(heading), np.sin(heading)
    along, across = error[..., 0], error[..., 1]
    return components(
        frame_pose[..., 0] + cos * along - sin * across,
        frame_pose[..., 1] + sin * along + cos * across,
        heading + error[..., 2],
    )
