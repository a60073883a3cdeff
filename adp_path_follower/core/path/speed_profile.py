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
from adp_path_follower.core.settings.groups import Settings

SHARE = 0.8  # eta: of accelerations and angular velocity; the rest is for corrections
_SLOWEST = 0.05  # [m/s], and ...
_SLOWEST_SHARE = 0.25  # ... of the highest speed: below, models take this for the speed
_UNLIKE = 0.1  # share by which a ramp differs from another one
_MAKES_GOOD = 0.3  # [s] at the highest speed in which lost time is made good, and ...
_PREVIEW = 1.0  # [s] at the highest speed in which it is foreseen, ...
_LEAST, _MOST = 0.7, 1.3  # by such a share of v_des
_GRIP = 2.0  # [m/s^2] that motors and floors give to most robots
_FOR_TURNS = 0.3  # share of a ramp that turns have for themselves, where time can be made good
_TURNING = 0.05  # [m] over which the change of curvature is taken


class SpeedProfile:
    """v_des at every arc length of a path."""

    @np.errstate(over="ignore")  # infinite ones are no limits
    def __init__(self, path: Path, settings: Settings) -> None:
        target, limits, motion = settings.target, settings.limits, settings.motion
        self._desired, fastest = target.desired_speed, float(limits.upper[0])
        self.highest = min(target.desired_speed, fastest)
        self.fastest = min(fastest, _MOST * self.highest)  # to make good what was lost
        # At rest a lateral error cannot be corrected, so no model has a solution there.
        self.slowest = min(_SLOWEST, _SLOWEST_SHARE * self.highest)
        self.stops = not path.closed and math.isfinite(motion.max_linear_decel)
        self._length, self._closed = path.length, path.closed
        curvature = path.samples.curvature
        pieces = len(curvature) - 1
        self._step = path.length / pieces
        hurried = self._pointwise(curvature, settings)
        if self.stops:
            hurried[-1] = 0.0
        bend = np.abs(curvature)
        bend = np.maximum(np.maximum(bend[:-1], bend[1:]), 1e-12)  # between two nodes
        turning = 0.5 * SHARE * motion.max_angular_accel / bend
        rise = 2.0 * self._step * np.minimum(SHARE * motion.max_linear_accel, turning)
        fall = 2.0 * self._step * np.minimum(SHARE * motion.max_linear_decel, turning)
        self._hurried = self._reachable(hurried, rise, fall)
        self._squared = self._reachable(np.minimum(hurried, self.highest**2), rise, fall)
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

    def within(self, ramp: float, hurries: bool = False) -> SpeedProfile:
        """Return the profile for a robot whose speed changes no faster than a ramp [m/s^2].

        If it hurries, `fastest` takes the place of `desired_speed`.
        """
        other, squared = copy.copy(self), self._hurried if hurries else self._squared
        most = np.full(len(squared) - 1, 2.0 * self._step * SHARE * ramp)
        other._squared, other.varies = self._reachable(squared, most, most), True
        return other

    def times(self) -> FloatArray:
        """Return when it passes its nodes (N,) [s], no slower than `slowest`."""
        speed = np.sqrt(np.maximum(self._squared, self.slowest**2))
        return np.append(0.0, np.cumsum(2.0 * self._step / (speed[1:] + speed[:-1])))

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
        speed: Number = np.sqrt(self.between_nodes(self._squared, arc_length))
        return speed

    def between_nodes(self, values: FloatArray, arc_length: FloatArray) -> FloatArray:
        """Return values at arc lengths (...) [m], linear between those at the nodes (N,)."""
        place = arc_length
        if self._closed:
            place = place - self._length * np.floor(place / self._length)
        position = np.fmin(np.fmax(place / self._step, 0.0), len(values) - 1.0)
        node = np.minimum(position.astype(np.intp), len(values) - 2)
        here, ahead = values[node], values[node + 1]
        return np.asarray(here + (position - node) * (ahead - here))

    def foreseen(self, values: FloatArray) -> FloatArray:
        """Return by how much growing values at the nodes (N,) grow within `_PREVIEW`, (N,).

        A closed path goes on as it began.
        """
        nodes = self._step * np.arange(len(values))
        ahead = nodes + _PREVIEW * self.highest
        growth = np.interp(ahead, nodes, values) - values
        if self._closed:
            growth += np.interp(ahead - self._length, nodes, values)
        return np.asarray(growth)

    def model_speed(self, arc_length: FloatArray) -> Number:
        """Return v_des, but nowhere less than `slowest`."""
        if not self.varies:
            return self._desired
        speed: Number = np.maximum(self.speed(arc_length), self.slowest)
        return speed

    def _pointwise(self, curvature: FloatArray, settings: Settings) -> FloatArray:
        """Return the highest v^2 at each node (N,), whatever is before and after it."""
        limits, motion = settings.limits, settings.motion
        bend = np.maximum(np.abs(curvature), 1e-12)
        bend[1:-1] = np.maximum(bend[1:-1], np.maximum(bend[:-2], bend[2:]))  # of the surroundings
        squared = np.minimum(self.fastest**2, motion.max_lateral_accel / bend)
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


class RampedSpeed:
    """The speed along a profile of a robot that changes it by a ramp.

    It brakes before a bend, and gets up to speed after it: it loses time on the target of the
    profile. To turn when that does, it is early before the bend and late after it. Therefore it is
    the faster the later it is, and the more time it is about to lose. As far as `max_linear_vel`
    leaves room for that, it changes its speed more gently: wheels that brake turn the less.
    """

    def __init__(self, profile: SpeedProfile, ramp: float) -> None:
        """Take the profile, and the ramp [m/s^2]."""
        room = (profile.fastest / profile.highest - 1.0) / (_MOST - 1.0)
        ramp = min(ramp * (1.0 - room * _FOR_TURNS), _GRIP)
        self._profile, self._most = profile, profile.within(ramp, hurries=True)
        self._loss = profile.foreseen(profile.within(ramp).times() - profile.times())
        self._gain = 1.0 / (profile.highest * _MAKES_GOOD)

    def speed(self, arc_length: FloatArray, wanted: Number, late: Number) -> Number:
        """Return it at arc lengths (...) [m], for what the profile wants, late by a time [s]."""
        loss = late + self._profile.between_nodes(self._loss, arc_length)
        share = np.minimum(np.maximum(1.0 + self._gain * wanted * loss, _LEAST), _MOST)
        speed: Number = np.minimum(self._most.speed(arc_length), wanted * share)
        return speed


class SpeedReference:
    """The profile, approached from the robot's speed within its accelerations."""

    def __init__(self, profile: SpeedProfile, settings: Settings) -> None:
        """Take the accelerations; the profile holds from the start until `launch` is called."""
        motion = settings.motion
        self.profile, self._forgets = profile, settings.target.target_gain
        self.stops, self._ramp = profile.stops, math.inf
        self._ramped: RampedSpeed | None = None
        self.late: Number = 0.0  # than the profile by a ramp since the launch [s], (...)
        self.rise = 2.0 * SHARE * motion.max_linear_accel  # of v_des^2 along the path [m/s^2]
        self._fall = 2.0 * SHARE * motion.max_linear_decel
        self._limited = math.isfinite(self.rise) or math.isfinite(self._fall)
        # Where it was launched [m], and v_des^2 there, (...) each; None before.
        self.start: tuple[FloatArray, Number] | None = None

    @property
    def varies(self) -> bool:
        """Return whether v_des is anything else than `desired_speed`, anywhere."""
        return self.profile.varies or self.start is not None  # a ramp changes only such speeds

    def launch(self, arc_length: FloatArray, speed: Number) -> None:
        """Approach the profile from a speed (...) [m/s] at arc lengths (...) [m]."""
        self.late = 0.0
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
            self._ramp, without = ramp, ramp == math.inf or not self.profile.varies
            self._ramped = None if without else RampedSpeed(self.profile, ramp)

    def spend(self, arc_length: FloatArray, time: float) -> None:
        """Note that a time [s] is spent from arc lengths (...) [m] on.

        Being late is forgotten by k1, as the target of the profile would wait for the robot.
        """
        if self._ramped is not None:
            wanted = np.maximum(self._wanted(arc_length), self.profile.slowest)
            gained = self.speed(arc_length) / wanted
            self.late = self.late + time * (1.0 - gained - self._forgets * self.late)

    def speed(self, arc_length: FloatArray) -> Number:
        """Return v_des at arc lengths (...) [m], as `SpeedProfile.speed`."""
        wanted = self._wanted(arc_length)
        return wanted if self._ramped is None else self._ramped.speed(arc_length, wanted, self.late)

    def _wanted(self, arc_length: FloatArray) -> Number:
        """Return v_des of a robot without a ramp."""
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
