"""The interface of every path-following controller here."""

from dataclasses import dataclass
from typing import Protocol

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import Settings


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
