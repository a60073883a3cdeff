"""Peers that drive by their error to the virtual target: a nonlinear law, and LQR."""

import math

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path, PathFrame
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.study.comparison.peer import PeerController


class LapierreSoetanto(PeerController):
    """The nonlinear law of Lapierre, Soetanto, Pascoal (CDC 2003), kinematic part.

    With the virtual target's speed s_p' = v cos(theta) + k1 s and the approach angle
    delta(y) = -theta_a tanh(k_delta y), the turn

        w = kappa s_p' + delta' - gamma y v (sin(theta) - sin(delta)) / (theta - delta)
            - k (theta - delta)

    lets V = (s^2 + y^2) / 2 + (theta - delta)^2 / (2 gamma) decrease. The virtual target is the one
    that all peers share, whose speed has v_des in the place of v; the sign of v in delta is left
    out, for v_des is positive. The law leaves the speed open; usual is v = v_des.
    """

    approach_angle = math.pi / 4.0  # heading error wanted far from the path [rad], below pi / 2
    approach_gain = 1.0  # how fast it is reached with the cross-track error [1/m]
    heading_gain = 1.0  # rate at which the heading follows [1/s]
    coupling = 1.0  # gamma, weight of the cross-track error in the turn [1/m^2]
    speed_gain = 0.0  # how much slower a robot drives that is ahead of its target [1/s]

    def command(
        self, pose: FloatArray, dt: float, frame: PathFrame, error: FloatArray
    ) -> FloatArray:
        """Return the speed and the turn of the law."""
        s, y, theta = np.moveaxis(error, -1, 0)
        speed = self.cruising_speed - self.speed_gain * s
        limits = self.settings.limits
        speed = np.clip(speed, limits.min_linear_vel, limits.max_linear_vel)
        target, v_des = self.settings.target, self.target.v_des
        target_speed = error_dynamics.target_speed(error, target, v_des)
        level = np.tanh(self.approach_gain * y)
        approach = -self.approach_angle * level
        y_rate = speed * np.sin(theta) - frame.curvature * s * target_speed
        slope = -self.approach_angle * self.approach_gain * (1.0 - level * level)
        # (sin(theta) - sin(delta)) / (theta - delta), smooth where both are equal.
        half = 0.5 * (theta - approach)
        secant = np.cos(theta - half) * np.sinc(half / math.pi)
        turn = (
            frame.curvature * target_speed
            + slope * y_rate
            - self.coupling * y * speed * secant
            - self.heading_gain * (theta - approach)
        )
        return np.stack([speed, turn], axis=-1)


class TunedLapierreSoetanto(LapierreSoetanto):
    """The same law at v = v_des - k s.

    The gains are the best by the score of `controllers` of k = 0.5, 0.75, 1, 1.25 1/s and
    gamma = 0.5, 1, 2 1/m^2.
    """

    coupling = 0.5
    speed_gain = 1.0


class Lqr(PeerController):
    """LQR scheduled by curvature: u = -R^-1 g(e)^T P(kappa) e.

    P solves the Riccati equation of the dynamics linearised about the path, but g is the true one:
    with g(0) a robot that stands across the path would still drive by s instead of y.
    """

    def __init__(self, settings: Settings, path: Path, arc_length: ArrayLike = 0.0) -> None:
        super().__init__(settings, path, arc_length)
        self._schedule = RiccatiSchedule(
            path, settings.target, settings.cost, self.reference.profile
        )
        self._input_cost_inverse = settings.cost.inverse_input_cost()

    def command(
        self, pose: FloatArray, dt: float, frame: PathFrame, error: FloatArray
    ) -> FloatArray:
        """Return the command of the policy."""
        v_des = self.target.v_des
        slope = np.matmul(self._schedule.matrix(frame.curvature, v_des), error[..., None])[..., 0]
        s_slope, y_slope, theta_slope = np.moveaxis(slope, -1, 0)
        theta = error[..., 2]
        pull = np.stack([np.cos(theta) * s_slope + np.sin(theta) * y_slope, theta_slope], axis=-1)
        feedforward = error_dynamics.feedforward(frame.curvature, v_des)
        return np.asarray(feedforward - pull @ self._input_cost_inverse)
