"""The path follower: poses in, commands out. Nodes, simulation and replay share this object."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.control.actuation import Actuation
from adp_path_follower.core.control.near_path import NearPath
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.control.virtual_target import VirtualTarget
from adp_path_follower.core.driving.arrival import Goal
from adp_path_follower.core.driving.command_law import CommandLaw
from adp_path_follower.core.driving.output import FollowerOutput
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.bellman import BellmanErrors, Observation
from adp_path_follower.core.learning.paper_learner import PathStateLearner
from adp_path_follower.core.learning.path_learner import Learner, PathLearner
from adp_path_follower.core.learning.weights import Weights
from adp_path_follower.core.learning.weights_file import SavedWeights, difference, problem_settings
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.speed_profile import SpeedProfile, SpeedReference
from adp_path_follower.core.settings.groups import Settings

_MOST_DOUBT = 0.5  # above it, it is the Riccati policy that drives
_MOST_HELD = 0.1  # [s] for which a command is expected to be held, as long as the last one was


class PathFollower:
    """Follow a path by the policy that is being learned.

    One object drives one robot, or a batch of robots at once: the leading axes of the pose and of
    the arc length are the batch.

    Attributes:
        path: The path that it follows.
        profile: The speed along it.
        reference: The same, approached from the robot's speed.
        goal: Whether its end is reached.
        law: Turns an error into a command.
        cost: J so far, by the trapezoidal rule over the control steps, shape (...).

    """

    def __init__(
        self,
        settings: Settings,
        path: Path,
        arc_length: ArrayLike = 0.0,
        weights: Weights | None = None,
        actuation: Actuation | None = None,
    ) -> None:
        """Start with virtual targets at arc lengths [m] of the path, one for each robot (...).

        The one set of weights of scheduling: path_state starts from `weights`, by default the
        settings' initial ones. `actuation` has recent commands; by default robots are at rest.
        """
        self.path = path
        self.profile = SpeedProfile(path, settings)
        self.goal = Goal(path, settings.motion, self.profile.stops)
        self._actuation = actuation if actuation is not None else Actuation()
        self.reference = SpeedReference(self.profile, settings)
        self._target = VirtualTarget(path, settings.target, arc_length, self.reference)
        riccati = RiccatiSchedule(path, settings.target, settings.cost, self.profile)
        self._learner: Learner
        if settings.learning.scheduling == "arc_length":
            # Robots that do not learn share their weights.
            batch = self.arc_length.shape if settings.learning.learning else ()
            self._learner = PathLearner(settings, riccati, batch)
        else:
            self._learner = PathStateLearner(settings, riccati, weights)
        near_path: NearPath | None = None
        if settings.robot.robot_model != "ideal" and settings.policy.tight_within > 0.0:
            near_path = NearPath(settings, riccati)
        self.law = CommandLaw(settings, riccati, self._learner, self._actuation, near_path)
        self.cost = np.zeros_like(self.arc_length)
        self._previous: FollowerOutput | None = None
        self._period = 0.0  # [s] of the last step

    @property
    def settings(self) -> Settings:
        """Return all settings; others may change the far policy, but not motion or learning."""
        return self.law.settings

    @settings.setter
    def settings(self, settings: Settings) -> None:
        self.law.change(settings)

    @property
    def arc_length(self) -> FloatArray:
        """Return s_p of the virtual target [m], shape (...)."""
        return self._target.arc_length

    @property
    def weights(self) -> Weights:
        """Return critic and actor weights where the target is, shape (..., L) each."""
        return self._learner.local(self.arc_length)

    @property
    def learning_problem(self) -> str:
        """Return why the Riccati policy has taken over, empty if it has not."""
        doubt = 0.0 if self._previous is None else self._previous.doubt.max()
        if not self._learner.problem and doubt > _MOST_DOUBT:
            return "the learned value function does not decrease where the robot is"
        return self._learner.problem

    def step(self, pose: FloatArray, dt: float, learn: bool = True) -> FollowerOutput:
        """Return the command for a pose [x, y, theta], shape (..., 3), after dt [s].

        Moves the virtual target over the past period, computes error and command there, then
        learns for one period. The first step, and the first one after `hold`, lets no time pass.
        With an actuation delay, all this is where the robot will be when the command takes effect.
        Without `learn`, learning is left to a call of `learn` before anything else is done.
        """
        elapsed = max(dt, 0.0)  # since the last command, which another follower may have given
        self._actuation.advance(elapsed)
        pose = self._actuation.predicted(pose, self.settings.motion.actuation_delay)
        if self._previous is None or dt < 0.0:
            dt = 0.0
        if self._previous is None or self._actuation.stopped:
            self.reference.launch(self.arc_length, self._actuation.command[..., 0])
        self._target.move(pose, dt)
        coming = None  # the paper's law feeds forward the curvature at the target
        if self.settings.learning.scheduling == "arc_length":
            held = min(dt, _MOST_HELD) or 1.0 / self.settings.controller.controller_frequency
            coming = self._target.coming_curvature(held)
        output = self.law.step(self._target, dt, coming)
        self._actuation.send(output.command, self.settings)
        self.goal.look(pose, output, dt)
        if self._previous is not None:
            mean_rate = 0.5 * (self._previous.running_cost + output.running_cost)
            self.cost = self.cost + dt * mean_rate
        self._previous, self._period = output, dt
        if learn:
            self.learn()
        return output

    def learn(self) -> None:
        """Learn for the period of the last step."""
        previous = self._previous
        assert previous is not None  # there has been one
        if self.settings.learning.learning:
            observation = Observation(self.arc_length, lambda: previous.measured)
            self._learner.learn(observation, self._period)

    def lead(self, pose: FloatArray, ahead: FloatArray, time: float) -> None:
        """Let the target move on before the first step, as commands take a time [s] to act.

        The robots are at a pose (..., 3), and will be ahead at another one (..., 3) by then.
        """
        self._target.move(pose, 0.0)
        self._target.move(ahead, time)
        self._target.hold()

    def step_at(self, pose: FloatArray, time: int, learn: bool = True) -> FollowerOutput:
        """Return the command for a pose at a time [ns] of any clock.

        Like `step` with the time since the last call. After a gap longer than `odom_timeout`, and
        after a step back of the clock, no time passes: nobody knows what the robot did meanwhile.
        """
        before = self._actuation.time
        elapsed = 0.0 if before is None else (time - before) * 1e-9
        if not 0.0 < elapsed <= self.settings.controller.odom_timeout:
            self.hold()
        self._actuation.time = time
        return self.step(pose, elapsed, learn)

    def learn_at_rest(self, pose: FloatArray, distance: float = 20.0) -> bool:
        """Learn with robots held at a pose (..., 3); return whether the weights settled.

        Where weights change along the path, they are learned for a distance [m] ahead.
        """
        self.hold()
        self._target.move(pose, 0.0)
        self._target.hold()

        def measure() -> BellmanErrors:
            return self.law.step(self._target, 0.0).measured

        return self._learner.settle(Observation(self.arc_length, measure, distance))

    def hold(self) -> None:
        """Let no time pass until the next step: the robot was stopped, or not observed."""
        self._previous = None
        self._target.hold()
        self.law.fallback.reset()  # at once it is decided anew which policy drives
        self._actuation.stop(forget=True)

    def reset_learning(self, where: np.ndarray | None = None) -> None:
        """Return to the initial weights, of the robots of a batch where (...) is true."""
        self._learner.reset(where)

    def take_over(self, previous: PathFollower) -> None:
        """Take over the weights of another follower, as far as they hold for this one.

        One set of weights for the whole path is kept and learns on. Weights along a path are kept
        while they are those of the same path and problem; of another one, the Riccati solution is
        the better start.
        """
        self._learner.take_over(previous._learner)

    def saved_weights(self) -> SavedWeights:
        """Return the learned weights and their settings, for a weights file."""
        return SavedWeights(problem_settings(self.settings), self._learner.learned())

    def start_from(self, saved: SavedWeights) -> str:
        """Go on from the weights of another run; return why they do not hold here, if so."""
        return difference(saved, self.settings) or self._learner.start_from(saved.learned)

    def reconfigured(self, settings: Settings) -> PathFollower:
        """Return a follower with other settings at the same place that has taken over from this."""
        other = PathFollower(settings, self.path, self.arc_length, actuation=self._actuation)
        other.take_over(self)
        other._target = self._target.copy(settings.target, other.reference)
        other.cost, other._previous = self.cost, self._previous
        if self._previous is not None:
            other.reference.launch(self.arc_length, self.reference.speed(self.arc_length))
        return other
