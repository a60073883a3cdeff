"""Stanley's steering law, on a virtual bicycle."""

import math

import numpy as np

from adp_path_follower.core.geometry import FloatArray, tracking_error
from adp_path_follower.core.path.curve import PathFrame
from adp_path_follower.core.path.nearest import place_near
from adp_path_follower.study.comparison.peers.peer import PeerController

_LEAST_SPEED = 1e-3  # [m/s]: the law divides by the speed


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
