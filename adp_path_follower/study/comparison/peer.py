"""The base of all peers: the virtual target of their error and cost, and their limits."""

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.actuation import Actuation
from adp_path_follower.core.control.policy import within
from adp_path_follower.core.control.virtual_target import VirtualTarget
from adp_path_follower.core.driving.output import ControlOutput
from adp_path_follower.core.geometry import FloatArray, Number
from adp_path_follower.core.path.curve import Path, PathFrame
from adp_path_follower.core.path.speed_profile import SpeedProfile, SpeedReference
from adp_path_follower.core.settings.groups import Settings


class PeerController(ABC):
    """A `Controller` for a batch of robots, with this controller's speed along the path and limits.

    Its commands are brought within the limits of velocity and acceleration, from rest on.
    """

    def __init__(self, settings: Settings, path: Path, arc_length: ArrayLike = 0.0) -> None:
        """Start with the virtual targets at arc lengths [m] of the path, shape (B,)."""
        self.settings = settings
        self.path = path
        self.reference = SpeedReference(SpeedProfile(path, settings), settings)
        self.target = VirtualTarget(path, settings.target, arc_length, self.reference)
        self.place: FloatArray = np.asarray(self.target.arc_length)  # near the robot, for some
        self._actuation = Actuation()

    @property
    def cruising_speed(self) -> Number:
        """Return the speed [m/s] of a peer that only steers, at the targets: (B,), or one for all.

        From rest it is reached by the limits of acceleration alone, which is cheaper.
        """
        return self.reference.profile.speed(self.target.arc_length)

    def step(self, pose: FloatArray, dt: float) -> ControlOutput:
        """Return the command for poses [x, y, theta], shape (B, 3), after dt [s]."""
        self._actuation.advance(max(dt, 0.0))
        if self._actuation.stopped:
            self.reference.launch(self.target.arc_length, 0.0)
        frame, error = self.target.move(pose, dt)
        wanted = within(self.command(pose, dt, frame, error), self.settings.limits)
        command = self._actuation.limited(wanted, self.settings)
        self._actuation.send(command, self.settings)
        feedforward = error_dynamics.feedforward(frame.curvature, self.target.v_des)
        return ControlOutput(
            command=command,
            modified_input=command - feedforward,
            error=error,
            target_pose=frame.pose,
            arc_length=self.target.arc_length,
            curvature=frame.curvature,
        )

    def reach(self, robots: int) -> FloatArray:
        """Return the lowest and the highest commands that may come next, shape (2, robots, 2)."""
        ends = np.array([-np.inf, np.inf])[:, None, None] + np.zeros((2, robots, 2))
        ends = np.array([within(end, self.settings.limits) for end in ends])
        return np.array([self._actuation.limited(end, self.settings) for end in ends])

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
