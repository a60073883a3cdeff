"""A controller on the estimator and the model of its robot, as the node runs its own."""

import dataclasses

from adp_path_follower.core.control.interface import Controller, ControlOutput
from adp_path_follower.core.control.virtual_target import VirtualTarget
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.robot.robot import Robot
from adp_path_follower.core.settings.groups import Settings


class ModelledController:
    """Asks a controller of one robot for the pose at which its command will act.

    Error, target and arc length in the output are those of the present pose.
    """

    def __init__(self, settings: Settings, controller: Controller, arc_length: FloatArray) -> None:
        """Take the settings of the robot's model, and where the target starts [m], shape (1,)."""
        self.settings, self.path = settings, controller.path
        self._controller, self._robot = controller, Robot(settings)
        self.reference = getattr(controller, "reference", None)
        self._target = VirtualTarget(self.path, settings.target, arc_length, self.reference)
        self._time = self._then = 0  # [ns]

    def step(self, pose: FloatArray, dt: float, motion: FloatArray) -> ControlOutput:
        """Return the command for a pose (1, 3) and v, w and age of the odometry (1, 3)."""
        first = self._time == 0
        self._time += round(1e9 * dt)
        ahead, then = self._robot.ahead(pose[0], self._time, motion[0])
        if first and then > self._time and hasattr(self._controller, "lead"):
            self._controller.lead(pose, ahead[None], (then - self._time) * 1e-9)
        elapsed, self._then = 0.0 if first else (then - self._then) * 1e-9, then
        if isinstance(self._controller, PathFollower):
            self._controller.law.robot_is_ideal = self._robot.ideal
        output = self._controller.step(ahead[None], elapsed)
        command = self._robot.command(output.command[0])
        self._robot.learn()
        frame, error = self._target.move(pose, dt)
        return dataclasses.replace(
            output,
            command=command[None],
            error=error,
            target_pose=frame.pose,
            arc_length=self._target.arc_length,
            curvature=frame.curvature,
        )
