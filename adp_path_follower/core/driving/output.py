"""Beginning and result of one control step, and the interface of every controller here."""

from dataclasses import dataclass
from typing import Protocol

from adp_path_follower.core.basis import Expansion, Numbers
from adp_path_follower.core.geometry import FloatArray, Number
from adp_path_follower.core.learning.bellman import BellmanErrors, SampleEvidence
from adp_path_follower.core.learning.weights import Weights
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import Settings


@dataclass(frozen=True)
class Counts:
    """How often a robot was interfered with since the node's start."""

    learning_resets: int = 0  # how often learning has been reset
    restarts: int = 0  # how often following has begun anew from where the robot was then
    stops: int = 0  # how often the robot has been told to stop after a command


@dataclass(frozen=True)
class Situation:
    """The state of equation (1), its motion, and the value function there."""

    zeta: FloatArray  # the state, shape (..., 4)
    arc_length: FloatArray  # s_p of the target [m], shape (...)
    curvature: FloatArray  # kappa at the target [1/m], shape (...)
    feedforward: FloatArray  # [v_ss, w_ss], shape (..., 2)
    heading: Numbers  # cos and sin of the heading error, numbers of shape (...)
    drift: Numbers  # f, four numbers of shape (...)
    expansion: Expansion  # sigma and sigma'
    weights: Weights  # critic and actor there
    passing: Number  # (dWc/ds_p)^T sigma s_p', shape (...)

    @property
    def place(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return zeta, kappa and [v_ss, w_ss], as policies take them."""
        return self.zeta, self.curvature, self.feedforward


@dataclass(frozen=True)
class ControlOutput:
    """The result of one control step; arrays have the leading axes of the pose.

    Attributes:
        command: [v, w] to apply [m/s, rad/s], shape (..., 2).
        modified_input: u = [v_e, w_e], the command less its feedforward, shape (..., 2).
        error: e = [s, y, theta] [m, m, rad], shape (..., 3).
        target_pose: Pose of the virtual target, shape (..., 3).
        arc_length: s_p [m], shape (...).
        curvature: kappa at the target [1/m], shape (...).

    """

    command: FloatArray
    modified_input: FloatArray
    error: FloatArray
    target_pose: FloatArray
    arc_length: FloatArray
    curvature: FloatArray


class Controller(Protocol):
    """A controller that follows a path: one robot, or a batch of robots by leading axes."""

    settings: Settings
    path: Path

    def step(self, pose: FloatArray, dt: float) -> ControlOutput:
        """Return the command for poses [x, y, theta], shape (..., 3), after dt [s]."""


@dataclass(frozen=True)
class FollowerOutput(ControlOutput):
    """The result of one control step of `PathFollower`."""

    running_cost: FloatArray  # e^T Q e + u^T R u, shape (...)
    weights: Weights  # critic and actor weights that gave the command, shape (..., L) each
    measured: BellmanErrors  # at the measured state
    sampled: BellmanErrors | SampleEvidence  # how well the samples determine the weights
    # Share of the Riccati policy, because the learned value function does not decrease here as
    # it must, shape (...).
    doubt: FloatArray

    @property
    def bellman_error(self) -> FloatArray:
        """Return delta at the measured state, shape (...)."""
        return self.measured.error[..., 0]

    @property
    def excitation(self) -> FloatArray:
        """Return the certificate of excitation, shape (...)."""
        return self.sampled.excitation
