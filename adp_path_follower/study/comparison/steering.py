"""Peers that only steer: pure pursuit, plain and regulated as in Nav2, and Stanley's law."""

import math

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.geometry import FloatArray, contiguous, tracking_error
from adp_path_follower.core.path.curve import Path, PathFrame
from adp_path_follower.core.path.nearest import place_near
from adp_path_follower.study.comparison.peer import PeerController

_LEAST_CARROT_SQUARED = 1e-3  # [m^2]: nearer than this there is no arc to it (Nav2)
# A chord is no shorter than 2 / pi of its arc, up to half a circle; the rest is for a bent path.
_ARC_OF_CHORD = 1.7
_LOOK_AHEAD_SAMPLES = 35
_BISECTIONS = 12
_LEAST_SPEED = 1e-3  # [m/s]: Stanley's law divides by the speed
_NAV2_PERIOD = 0.05  # [s] of Nav2's controller server: stands in where no time has passed


def pursuit_curvature(carrot: FloatArray) -> FloatArray:
    """Return the curvature [1/m] of the arc to points [x, y, ...] from the robot, shape (...)."""
    along, across = carrot[..., 0], carrot[..., 1]
    away = np.hypot(along, across)
    # Divided twice, as the square of a distance could overflow.
    safe = np.maximum(away, math.sqrt(_LEAST_CARROT_SQUARED))
    curvature = 2.0 * (across / safe) / safe
    return np.asarray(np.where(away > math.sqrt(_LEAST_CARROT_SQUARED), curvature, 0.0))


class PurePursuit(PeerController):
    """Pure pursuit (Coulter, CMU-RI-TR-92-01, 1992): steer along the arc to a point ahead."""

    lookahead = 1.0  # [m], as in MATLAB's controllerPurePursuit

    def command(
        self, pose: FloatArray, dt: float, frame: PathFrame, error: FloatArray
    ) -> FloatArray:
        """Return v_des and the turn that follows the arc to the point ahead."""
        self.place = place_near(self.path, pose, self.place)
        curvature = pursuit_curvature(_carrot(self.path, pose, self.place, self.lookahead))
        speed = np.full_like(curvature, self.cruising_speed)
        return np.stack([speed, speed * curvature], axis=-1)


class TunedPurePursuit(PurePursuit):
    """Pure pursuit with the best of 0.2, 0.3, ..., 1.3 and 1.5 m by the score of `controllers`."""

    lookahead = 0.6


class RegulatedPurePursuit(PeerController):
    """Pure pursuit with Nav2's rules (Macenski et al., arXiv 2305.20026, 2023).

    The look-ahead distance may grow with speed; the robot slows down in tight turns, and turns in
    place towards a point that is far to the side. Left out is what needs a costmap or a goal:
    slowing down near obstacles, collision checks, the approach to the goal and the turn there; and
    what Nav2 has switched off: reversing, and a second point ahead for the curvature.
    """

    # Nav2's parameters of the rules, with the defaults that it publishes and by its names.
    lookahead_dist = 0.6  # look-ahead distance where it does not depend on speed [m]
    use_velocity_scaled_lookahead_dist = False  # whether it does
    lookahead_time = 1.5  # look-ahead distance by speed [s]
    min_lookahead_dist = 0.3  # least one by speed [m]
    max_lookahead_dist = 0.9  # greatest one by speed [m]
    # Turning radius below which the robot slows down [m].
    regulated_linear_scaling_min_radius = 0.9
    regulated_linear_scaling_min_speed = 0.25  # speed that it keeps [m/s]
    # Angle to the point ahead beyond which it turns in place [rad].
    rotate_to_heading_min_angle = 0.785
    rotate_to_heading_angular_vel = 1.8  # speed of that turn [rad/s]
    max_angular_accel = 3.2  # acceleration of that turn [rad/s^2]

    def command(
        self, pose: FloatArray, dt: float, frame: PathFrame, error: FloatArray
    ) -> FloatArray:
        """Return the regulated speed along the arc to the point ahead, or a turn in place."""
        # The last command, in place of the odometry's twist, which Nav2 takes.
        twist = np.broadcast_to(self._actuation.command, (*pose.shape[:-1], 2))
        self.place = place_near(self.path, pose, self.place)
        carrot = _carrot(self.path, pose, self.place, self.lookahead(twist[..., 0]))
        curvature = pursuit_curvature(carrot)
        speed = self.regulated_speed(curvature)
        bearing = np.arctan2(contiguous(carrot[..., 1]), contiguous(carrot[..., 0]))
        turning = np.abs(bearing) > self.rotate_to_heading_min_angle
        linear = np.where(turning, 0.0, speed)
        turn = self._turn_in_place(bearing, twist[..., 1], dt if dt > 0.0 else _NAV2_PERIOD)
        return np.stack([linear, np.where(turning, turn, speed * curvature)], axis=-1)

    def lookahead(self, speed: FloatArray) -> FloatArray:
        """Return the look-ahead distance [m] at speeds [m/s], same shape."""
        if not self.use_velocity_scaled_lookahead_dist:
            return np.full_like(speed, self.lookahead_dist)
        scaled = np.abs(speed) * self.lookahead_time
        return np.clip(scaled, self.min_lookahead_dist, self.max_lookahead_dist)

    def regulated_speed(self, curvature: FloatArray) -> FloatArray:
        """Return the speed [m/s] on arcs of a curvature [1/m], same shape."""
        speed = self.cruising_speed
        # v_des (1 - |r - r_min| / r_min) for r < r_min is v_des r / r_min.
        share = np.maximum(np.abs(curvature) * self.regulated_linear_scaling_min_radius, 1.0)
        regulated = np.maximum(speed / share, self.regulated_linear_scaling_min_speed)
        return np.asarray(np.minimum(regulated, speed))

    def _turn_in_place(self, bearing: FloatArray, turn: FloatArray, dt: float) -> FloatArray:
        """Return w [rad/s] that turns towards a bearing [rad] from a turn [rad/s], same shape."""
        wanted = np.copysign(self.rotate_to_heading_angular_vel, bearing)
        change = self.max_angular_accel * dt
        feasible = np.clip(wanted, turn - change, turn + change)
        # No faster than what can still stop at the bearing.
        stopping = np.sqrt(2.0 * self.max_angular_accel * np.abs(bearing))
        fast = np.abs(feasible) > stopping
        return np.asarray(np.where(fast, np.copysign(stopping, bearing), feasible))


class TunedRegulatedPurePursuit(RegulatedPurePursuit):
    """The same rules with the look-ahead distance by speed.

    They are the best by the score of `controllers` of look-ahead times 0.8, 1, 1.2, 1.5 s, radii
    0.9, 0.3 m and angles 0.785, 1.2, 1.57 rad.
    """

    use_velocity_scaled_lookahead_dist = True
    lookahead_time = 1.2
    regulated_linear_scaling_min_radius = 0.3
    rotate_to_heading_min_angle = 1.57


def place_ahead(path: Path, pose: FloatArray, place: FloatArray, distance: ArrayLike) -> FloatArray:
    """Return the arc length [m] of the place looked ahead to, shape (B,).

    Takes poses [x, y, theta] (B, 3), the arc length of their nearest places [m] (B,), and how far
    to look ahead [m], shape () or (B,). The place is the first one from the nearest on at this
    distance from the robot: the nearest itself, if the robot is farther from the path; the farthest
    in reach, if a bend is too tight for any to be that far away.
    """
    distance = np.broadcast_to(np.asarray(distance, dtype=float), pose.shape[:-1])
    span = _ARC_OF_CHORD * distance[..., None]
    samples = place[..., None] + span * np.linspace(0.0, 1.0, _LOOK_AHEAD_SAMPLES)
    distances = _distance(path, pose, samples)
    reached = distances >= distance[..., None]
    some = reached.any(axis=-1)
    index = np.where(some, np.argmax(reached, axis=-1), np.argmax(distances, axis=-1))
    high = np.take_along_axis(samples, index[..., None], axis=-1)[..., 0]
    low = np.take_along_axis(samples, np.maximum(index - 1, 0)[..., None], axis=-1)[..., 0]
    low = np.where(some, low, high)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        beyond = _distance(path, pose, middle[..., None])[..., 0] >= distance
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return np.asarray(high)


def _distance(path: Path, pose: FloatArray, arc_length: FloatArray) -> FloatArray:
    """Return the distance [m] of poses (B, 3) to each of their K places (B, K), shape (B, K)."""
    away = path.frame(arc_length).pose[..., :2] - pose[..., None, :2]
    return np.hypot(away[..., 0], away[..., 1])


def _carrot(path: Path, pose: FloatArray, place: FloatArray, lookahead: ArrayLike) -> FloatArray:
    """Return the point ahead in the robot's frame, [x, y, heading] (B, 3)."""
    return tracking_error(path.frame(place_ahead(path, pose, place, lookahead)).pose, pose)


class Stanley(PeerController):
    """Stanley (Hoffmann, Tomlin, Montemerlo, Thrun, ACC 2007): steer a bicycle's front wheel.

    The kinematic law: delta = -theta - arctan(k y / v), with heading and cross-track error at the
    front axle. A unicycle has no front axle; the robot is taken for the rear axle of a bicycle,
    w = v tan(delta) / wheelbase. The usual gain and steering limit are those of MATLAB's
    lateralControllerStanley; its wheelbase is a car's, so a small robot's stands in.

    With the front axle on the path, the robot itself cuts the bends, which `TunedStanley` mends.
    """

    position_gain = 2.5  # k [1/s], on the cross-track error
    wheelbase = 0.3  # of the virtual bicycle whose rear axle is the robot's [m]
    max_steering = math.radians(35.0)  # [rad]
    at_front_axle = True  # whether errors are taken at the front axle, or at the robot
    curvature_feedforward = False  # whether the path's curvature is steered, too

    def command(
        self, pose: FloatArray, dt: float, frame: PathFrame, error: FloatArray
    ) -> FloatArray:
        """Return v_des and the turn of the virtual bicycle."""
        speed = np.maximum(self.cruising_speed, _LEAST_SPEED)
        reference = pose.copy()
        if self.at_front_axle:
            reference[..., 0] += self.wheelbase * np.cos(pose[..., 2])
            reference[..., 1] += self.wheelbase * np.sin(pose[..., 2])
        self.place = place_near(self.path, reference, self.place)
        place = self.path.frame(self.place)
        _, cross_track, heading = np.moveaxis(tracking_error(reference, place.pose), -1, 0)
        steering = -heading - np.arctan(self.position_gain * cross_track / speed)
        if self.curvature_feedforward:
            steering = steering + np.arctan(self.wheelbase * place.curvature)
        steering = np.clip(steering, -self.max_steering, self.max_steering)
        turn = speed * np.tan(steering) / self.wheelbase
        return np.stack([np.full_like(turn, self.cruising_speed), turn], axis=-1)


class TunedStanley(Stanley):
    """Stanley's law with the errors at the robot, and arctan(wheelbase kappa) fed forward.

    The gains are the best by the score of `controllers` of k = 0.3, 0.5, 0.75, 1, 1.5, 2.5 1/s and
    wheelbases 0.1, 0.2, 0.3, 0.5 m.
    """

    position_gain = 0.5
    at_front_axle = False
    curvature_feedforward = True
