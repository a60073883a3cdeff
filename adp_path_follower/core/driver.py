"""One robot on the paths that come: what stays when path, settings or place change."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

from adp_path_follower.core.actuation import Actuation
from adp_path_follower.core.follower import FollowerOutput, PathFollower
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path import Path
from adp_path_follower.core.settings import Settings
from adp_path_follower.core.weights_file import SavedWeights


@dataclass(frozen=True)
class Change:
    """A change of settings that is ready to be taken over."""

    settings: Settings
    follower: PathFollower | None


class Driver:
    """Drive one robot, between changes of path and settings; the node and replay share it.

    Every change takes effect with the next step, so that a run is known from its steps and from
    the step that each change came after.

    Attributes:
        settings: All settings.
        path: The path to follow, None without one.
        learning_resets: How often learning has been reset.
        restarts: How often following has begun anew from where the robot was then.
        saved_weights: Weights of another run to start from, None without.
        stops: How often the robot has been told to stop after a command.

    """

    def __init__(
        self,
        settings: Settings,
        saved_weights: SavedWeights | None = None,
        tell: Callable[[str], object] = bool,
    ) -> None:
        """Begin without a path.

        Args:
            settings: All settings.
            saved_weights: Weights of another run to start from, on paths for which they hold.
            tell: Called with a sentence where they do not.

        """
        self.settings = settings
        self.saved_weights, self._tell = saved_weights, tell
        self.path: Path | None = None
        self.learning_resets = 0
        self.restarts = 0
        self.stops = 0
        self._actuation = Actuation()
        self._follower: PathFollower | None = None
        self._learned: PathFollower | None = None  # the follower of the path before

    @property
    def follower(self) -> PathFollower | None:
        """Return the follower of the path, None before the first step on it."""
        return self._follower

    @property
    def at_goal(self) -> bool:
        """Return whether the robot is at the end of an open path."""
        return self._follower is not None and bool(self._follower.goal.reached)

    def follow(self, path: Path | None) -> None:
        """Follow another path from the next step on, or none."""
        if path is not None and self._follower is not None:
            self._learned = self._follower
        self.path, self._follower = path, None

    def change_settings(self, settings: Settings) -> None:
        """Go on with other settings.

        Raises:
            SettingsError: No policy can be found for them; the present ones stay.

        """
        self.take_over(self.prepared(settings))

    def prepared(self, settings: Settings) -> Change:
        """Return the change to other settings, which `take_over` makes at once.

        Raises:
            SettingsError: No policy can be found for them.

        """
        same_motion = dataclasses.replace(settings, controller=self.settings.controller)
        if self._follower is None or same_motion == self.settings:
            return Change(settings, self._follower)
        return Change(settings, self._follower.reconfigured(settings))

    def take_over(self, change: Change) -> None:
        """Go on with a change that was prepared since the last step."""
        self.settings, self._follower = change.settings, change.follower
        if self._follower is not None:
            self._follower.settings = change.settings

    def reset_learning(self) -> None:
        """Return to the initial weights of the settings, also where there were saved ones."""
        self._learned = self.saved_weights = None
        if self._follower is not None:
            self._follower.reset_learning()
        self.learning_resets += 1

    def restart(self) -> bool:
        """Begin anew where the robot will be, which may have been carried; return if it had begun.

        What was learned stays.
        """
        if self._follower is None:
            return False
        self._learned, self._follower = self._follower, None
        self.restarts += 1
        return True

    def stopped(self) -> bool:
        """Note that the robot was told to stop; return if it had been told anything else."""
        if self._actuation.stopped:
            return False
        self._actuation.stop()
        self.stops += 1
        return True

    def step(self, pose: FloatArray, time: int) -> FollowerOutput:
        """Return the command for a pose [x, y, theta] (3,) at a time [ns]; there must be a path.

        Raises:
            SettingsError: No policy can be found for these settings on this path.

        """
        follower = self._follower or self._begin(pose)
        return follower.step_at(pose, time)

    def _begin(self, pose: FloatArray) -> PathFollower:
        assert self.path is not None  # the caller waits for one
        beginning = self.settings.controller.path_start == "beginning"
        arc_length = 0.0 if beginning else self.path.nearest(pose)
        follower = PathFollower(self.settings, self.path, arc_length, actuation=self._actuation)
        if self.saved_weights is not None:
            problem = follower.start_from(self.saved_weights)
            if problem:
                self._tell(
                    f"the weights of 'weights_file' are not used on this path: {problem}; learning "
                    "starts from the initial weights"
                )
        if self._learned is not None:
            follower.take_over(self._learned)
        self._follower, self._learned = follower, None
        return follower
