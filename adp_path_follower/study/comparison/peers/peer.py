"""The base of all peers: the virtual target that gives their error and cost."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.interface import ControlOutput
from adp_path_follower.core.control.virtual_target import VirtualTarget
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path, PathFrame
from adp_path_follower.core.settings.groups import Settings


class PeerController(ABC):
    """A `Controller` for a batch of robots that are told a clipped command at every step."""

    def __init__(self, settings: Settings, path: Path, arc_length: ArrayLike = 0.0) -> None:
        """Start with the virtual targets at arc lengths [m] of the path, shape (B,)."""
        self.settings = settings
        self.path = path
        self.target = VirtualTarget(path, settings.target, arc_length)
        self.place: FloatArray = np.asarray(self.target.arc_length)  # near the robot, for some

    @property
    def cruising_speed(self) -> float:
        """Return v_des [m/s] as far as the limits allow it: what a peer that only steers holds."""
        return min(self.settings.target.desired_speed, self.settings.limits.max_linear_vel)

    def step(self, pose: FloatArray, dt: float) -> ControlOutput:
        """Return the command for poses [x, y, theta], shape (B, 3), after dt [s]."""
        frame, error = self.target.move(pose, dt)
        limits = self.settings.limits
        command = np.clip(self.command(pose, dt, frame, error), limits.lower, limits.upper)
        v_des = self.settings.target.desired_speed
        feedforward = error_dynamics.feedforward(frame.curvature, v_des)
        return ControlOutput(
            command=command,
            modified_input=command - feedforward,
            error=error,
            target_pose=frame.pose,
            arc_length=self.target.arc_length,
            curvature=frame.curvature,
        )

    def lead(self, pose: FloatArray, ahead: FloatArray, time: float) -> None:
        """Let the target move on before the first step, as `PathFollower.lead`."""
        self.target.move(pose, 0.0)
        self.target.move(ahead, time)

    @abstractmethod
    def command(
        self, pose: FloatArray, dt: float, frame: PathFrame, error: FloatArray
    ) -> FloatArray:
        """Return the wanted command [v, w], shape (B, 2), for poses (B, 3), dt [s] after the last.

        `frame` is the path's at the virtual targets, `error` e = [s, y, theta] to them, (B, 3).
        """
