"""The speed along a path, v_des(s_p): as fast as curvature, limits and the way ahead allow.

Pointwise, with a share eta of the robot's limits, which leaves the rest to corrections,

    v_des <= min(desired_speed, max_linear_vel, speed_limit, sqrt(a_lat / |kappa|),
                 eta w_max / |kappa|, sqrt(eta alpha_max / (2 |kappa'|))),

and along the path |d(v_des^2) / ds| <= 2 min(eta a, eta alpha_max / (2 |kappa|)): a forward pass
with the acceleration, a backward pass with the deceleration, from zero at the end of an open path.
So both parts of w_ss' = kappa' v_des^2 + kappa v_des' have half of the angular acceleration.
v_des^2 is linear between the nodes, as it is under a constant acceleration.
"""

from __future__ import annotations

import copy
import math

import numpy as np

from adp_path_follower.core.geometry import FloatArray, Number
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import Settings, TargetSettings

SHARE = 0.8  # eta: of accelerations and angular velocity; the rest is for corrections
_SLOWEST = 0.05  # [m/s], and ...
_SLOWEST_SHARE = 0.25  # ... of the highest speed: below, models take this for the speed
_UNLIKE = 0.1  # share by which a ramp differs from another one
_TURNING = 0.05  # [m] over which the change of curvature is taken


class ConstantSpeed:
    """`desired_speed` [m/s] at every arc length: the speed of an optimum, and of peers."""

    varies = stops = False

    def __init__(self, target: TargetSettings) -> None:
        self.highest = self.slowest = target.desired_speed

    def speed(self, arc_length: FloatArray) -> Number:
        """Return v_des [m/s], one number for all arc lengths."""
        return self.highest

    model_speed = speed


class SpeedProfile:
    """v_des at every arc length of a path."""

    @np.errstate(over="ignore")  # infinite ones are no limits
    def __init__(self, path: Path, settings: Settings) -> None:
        """Find the speeds at nodes along the path."""
        target, limits, motion = settings.target, settings.limits, settings.motion
        self._desired = target.desired_speed
        self.highest = min(target.desired_speed, float(limits.upper[0]))
        # At rest a lateral error cannot be corrected, so no model has a solution there.
        self.slowest = min(_SLOWEST, _SLOWEST_SHARE * self.highest)
        self.stops = not path.closed and math.isfinite(motion.max_linear_decel)
        self._length, self._closed = path.length, path.closed
        curvature = path.samples.curvature
        pieces = len(curvature) - 1
        self._step = path.length / pieces
        squared = self._pointwise(curvature, settings)
        if self.stops:
            squared[-1] = 0.0
        bend = np.abs(curvature)
        bend = np.maximum(np.maximum(bend[:-1], bend[1:]), 1e-12)  # between two nodes
        turning = 0.5 * SHARE * motion.max_angular_accel / bend
        rise = 2.0 * self._step * np.minimum(SHARE * motion.max_linear_accel, turning)
        fall = 2.0 * self._step * np.minimum(SHARE * motion.max_linear_decel, turning)
        self._squared = self._reachable(squared, rise, fall)
        self.varies = bool((self._squared != self._desired**2).any())

    def _reachable(self, squared: FloatArray, rise: FloatArray, fall: FloatArray) -> FloatArray:
        """Return v_des^2 (N,) that rises and falls by no more than that between nodes (N - 1,)."""
        pieces = len(rise)
        if self._closed:  # the middle lap of three sees a lap before and after it
            squared = np.concatenate([squared[:-1], squared[:-1], squared])
            rise, fall = np.tile(rise, 3), np.tile(fall, 3)
        squared = _at_most_rising_by(squared, rise)
        squared = _at_most_rising_by(squared[::-1], fall[::-1])[::-1]
        return squared[pieces : 2 * pieces + 1] if self._closed else squared

    def within(self, ramp: float) -> SpeedProfile:
        """Return the profile for a robot whose speed changes no faster than a ramp [m/s^2]."""
        other = copy.copy(self)
        most = np.full(len(self._squared) - 1, 2.0 * self._step * SHARE * ramp)
        other._squared = self._reachable(self._squared, most, most)
        other.varies = bool((other._squared != self._desired**2).any())
        return other

    def same_as(self, other: SpeedProfile) -> bool:
        """Return whether the speeds are the same everywhere."""
        mine, theirs = (self._step, self._desired), (other._step, other._desired)
        return mine == theirs and np.array_equal(self._squared, other._squared)

    def speed(self, arc_length: FloatArray) -> Number:
        """Return v_des [m/s] at arc lengths s_p [m] of any shape, same shape or one number.

        Beyond the ends of an open path the speed at the end holds. A constant profile returns one
        number for all arc lengths.
        """
        if not self.varies:
            return self._desired
        place = arc_length
        if self._closed:
            place = place - self._length * np.floor(place / self._length)
        position = np.fmin(np.fmax(place / self._step, 0.0), len(self._squared) - 1.0)
        node = np.minimum(position.astype(np.intp), len(self._squared) - 2)
        squared, ahead = self._squared[node], self._squared[node + 1]
        speed: Number = np.sqrt(squared + (position - node) * (ahead - squared))
        return speed

    def model_speed(self, arc_length: FloatArray) -> Number:
        """Return v_des, but nowhere less than `slowest`."""
        if not self.varies:
            return self._desired
        speed: Number = np.maximum(self.speed(arc_length), self.slowest)
        return speed

    def _pointwise(self, curvature: FloatArray, settings: Settings) -> FloatArray:
        """Return the highest v_des^2 at each node (N,), whatever is before and after it."""
        limits, motion = settings.limits, settings.motion
        bend = np.maximum(np.abs(curvature), 1e-12)
        bend[1:-1] = np.maximum(bend[1:-1], np.maximum(bend[:-2], bend[2:]))  # of the surroundings
        squared = np.full(len(bend), self.highest**2)
        squared = np.minimum(squared, motion.max_lateral_accel / bend)
        squared = np.minimum(squared, (SHARE * limits.max_angular_vel / bend) ** 2)
        if math.isfinite(motion.max_angular_accel):
            reach = max(1, round(0.5 * _TURNING / self._step))
            nodes = np.arange(len(curvature))
            before, after = nodes - reach, nodes + reach
            if self._closed:  # whose last node is its first
                before, after = before % (len(nodes) - 1), after % (len(nodes) - 1)
            else:
                before, after = np.maximum(before, 0), np.minimum(after, len(nodes) - 1)
            change = np.abs(curvature[after] - curvature[before])
            slope = np.maximum(change / (2.0 * reach * self._step), 1e-12)
            squared = np.minimum(squared, 0.5 * SHARE * motion.max_angular_accel / slope)
        return np.asarray(squared)


class SpeedReference:
    """The profile, approached from the robot's speed within its accelerations.

    Attributes:
        profile: The profile itself.
        stops: Whether the robot brakes to the end of the path.
        rise: By how much v_des^2 may rise along the path, from the start on [m/s^2].
        start: Where it was launched [m], and v_des^2 there, (...) each; None before.

    """

    def __init__(self, profile: SpeedProfile, settings: Settings) -> None:
        """Take the accelerations; the profile holds from the start until `launch` is called."""
        motion = settings.motion
        self._full = self.profile = profile
        self.stops, self._ramp = profile.stops, math.inf
        self.rise = 2.0 * SHARE * motion.max_linear_accel
        self._fall = 2.0 * SHARE * motion.max_linear_decel
        self._limited = math.isfinite(self.rise) or math.isfinite(self._fall)
        self.start: tuple[FloatArray, Number] | None = None

    @property
    def varies(self) -> bool:
        """Return whether v_des is anything else than `desired_speed`, anywhere."""
        return self.profile.varies or self.start is not None

    def launch(self, arc_length: FloatArray, speed: Number) -> None:
        """Approach the profile from a speed (...) [m/s] at arc lengths (...) [m]."""
        if self._limited:
            from_rest = np.maximum(speed, self.profile.slowest)  # at zero it would never start
            self.start = (arc_length, from_rest**2)

    def of_robot(self, number: int) -> SpeedReference:
        """Return that of one robot of the batch (B,) with which this was launched."""
        other = copy.copy(self)
        if self.start is not None:
            start, squared = map(np.ravel, np.broadcast_arrays(*self.start))
            other.start = (start[number % len(start)], squared[number % len(start)])
        return other

    def keep_within(self, ramp: float) -> None:
        """Change the speed no faster than a ramp [m/s^2] that the robot seems to have."""
        if abs(1.0 / ramp - 1.0 / self._ramp) > _UNLIKE / self._ramp:
            self._ramp, self.profile = ramp, self._full.within(ramp)

    def speed(self, arc_length: FloatArray) -> Number:
        """Return v_des at arc lengths (...) [m], as `SpeedProfile.speed`."""
        wanted = self.profile.speed(arc_length)
        if self.start is None:
            return wanted
        start, squared = self.start
        run = np.maximum(arc_length - start, 0.0)
        if math.isfinite(self._fall):
            wanted = np.maximum(wanted, np.sqrt(np.maximum(squared - self._fall * run, 0.0)))
        if math.isfinite(self.rise):
            wanted = np.minimum(wanted, np.sqrt(squared + self.rise * run))
        return wanted


def _at_most_rising_by(values: FloatArray, steps: FloatArray) -> FloatArray:
    """Return the greatest values (N,) below those given that rise by at most steps (N - 1,)."""
    if np.isinf(steps).all():
        return values
    # To rise by the highest of them is to rise to any of them; without it, sums may overflow.
    slope = np.append(0.0, np.cumsum(np.minimum(steps, values.max())))
    reached = np.minimum.accumulate(values - slope) + slope
    return np.where(reached < (1.0 - 1e-12) * values, reached, values)  # but for rounding


def speed_from_rest(path: Path, settings: Settings, arc_length: float) -> SpeedReference:
    """Return the speed along a path for a robot that starts from rest at an arc length [m]."""
    reference = SpeedReference(SpeedProfile(path, settings), settings)
    reference.launch(np.asarray(arc_length), 0.0)
    return reference


def passing_times(reference: SpeedReference, arc_length: FloatArray) -> FloatArray:
    """Return when v_des passes increasing arc lengths (N,) [m], from the first on, (N,) [s].

    Exact where accelerations are constant between them; infinite beyond a place where it stops.
    """
    speed = np.broadcast_to(reference.speed(arc_length), arc_length.shape)
    with np.errstate(divide="ignore"):
        steps = 2.0 * np.diff(arc_length) / (speed[1:] + speed[:-1])
    return np.append(0.0, np.cumsum(steps))
