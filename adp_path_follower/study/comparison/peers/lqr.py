"""The linear-quadratic regulator, scheduled by curvature."""

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path, PathFrame
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.study.comparison.peers.peer import PeerController


class Lqr(PeerController):
    """LQR scheduled by curvature: u = -R^-1 g(e)^T P(kappa) e.

    P solves the Riccati equation of the dynamics linearised about the path, but g is the true one:
    with g(0) a robot that stands across the path would still drive by s instead of y.
    """

    def __init__(self, settings: Settings, path: Path, arc_length: ArrayLike = 0.0) -> None:
        """Solve the Riccati equation over the path's curvatures."""
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
