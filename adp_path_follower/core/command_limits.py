"""How far a command may be from the one before: limits of acceleration and jerk."""

from __future__ import annotations

import numpy as np

from adp_path_follower.core.geometry import FloatArray, components, unpacked
from adp_path_follower.core.settings import LimitSettings, MotionSettings


def limited_command(
    wanted: FloatArray,
    previous: FloatArray,
    rate: FloatArray,
    limits: LimitSettings,
    motion: MotionSettings,
    dt: float,
) -> FloatArray:
    """Return the command nearest to the wanted one that can follow the previous one, (..., 2).

    Limits of acceleration always hold, those of velocity unless the previous command is beyond
    them; then it returns to them as fast as accelerations allow. A limit of jerk gives way to both.

    Args:
        wanted: [v, w] within the limits of velocity, shape (..., 2).
        previous: The last command, shape (..., 2).
        rate: How fast it was changing [m/s², rad/s²], shape (..., 2).
        limits: Of velocity.
        motion: Of acceleration and jerk.
        dt: Time since the last command [s], above 0.

    """
    lower, upper = _within_reach(previous, motion, dt)
    if motion.jerk_limited:
        jerk = np.array([motion.max_linear_jerk, motion.max_angular_jerk])
        beyond = (previous < limits.lower) | (previous > limits.upper)
        wanted = np.where(beyond, wanted, _smoothed(wanted, previous, rate, jerk, dt))
        lower = np.maximum(lower, np.minimum(limits.lower, previous))
        upper = np.minimum(upper, np.maximum(limits.upper, previous))
    return np.asarray(np.minimum(np.maximum(wanted, lower), upper))


def _within_reach(
    previous: FloatArray, motion: MotionSettings, dt: float
) -> tuple[FloatArray, FloatArray]:
    """Return the least and the greatest [v, w] that accelerations allow, shape (..., 2) each.

    From driving one way v gets to the other way by zero: it brakes with one acceleration and goes
    on with another.
    """
    v, w = unpacked(previous)
    rise, fall = motion.max_linear_accel * dt, motion.max_linear_decel * dt
    turn = motion.max_angular_accel * dt
    least = np.where(v > 0.0, np.maximum(v - fall, 0.0), v - rise)
    greatest = np.where(v < 0.0, np.minimum(v + fall, 0.0), v + rise)
    return components(least, w - turn), components(greatest, w + turn)


def _smoothed(
    wanted: FloatArray, previous: FloatArray, rate: FloatArray, jerk: FloatArray, dt: float
) -> FloatArray:
    """Return the command after limits of jerk (2,), shape (..., 2).

    The rate of change r stays below what jerk j can take back to zero before the wanted command is
    reached: r, r - j dt, r - 2 j dt, ... sum up to r² / 2j + r dt / 2, and at most j dt² / 8 more
    because the last of them is not zero.
    """
    change = wanted - previous
    limited = np.isfinite(jerk)
    jerk = np.where(limited, jerk, 1.0)
    half = 0.5 * jerk * dt
    highest = np.sqrt(half * half + 2.0 * jerk * np.abs(change)) - half
    reached = np.minimum(np.maximum(change / dt, -highest), highest)
    reached = np.minimum(np.maximum(reached, rate - jerk * dt), rate + jerk * dt)
    return np.asarray(np.where(limited, previous + reached * dt, wanted))
