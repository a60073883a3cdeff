"""The path follower: poses in, commands out. Nodes, simulation and replay share this object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.actuation import Actuation
from adp_path_follower.core.control.cost import RunningCost
from adp_path_follower.core.control.fallback import Distrust, RiccatiPolicy, is_doubtful
from adp_path_follower.core.control.far_from_path import WideRegion
from adp_path_follower.core.control.interface import ControlOutput
from adp_path_follower.core.control.policy import descending_input, saturate, within
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.control.virtual_target import VirtualTarget
from adp_path_follower.core.driving.arrival import Goal
from adp_path_follower.core.driving.command_law import _product, _Situation, _Unforced
from adp_path_follower.core.geometry import FloatArray, components, cos, numbers, sin
from adp_path_follower.core.learning.batch_learner import FleetLearner
from adp_path_follower.core.learning.bellman import BellmanErrors, bellman_errors
from adp_path_follower.core.learning.learner import Evidence, Learner
from adp_path_follower.core.learning.paper_learner import PathStateLearner
from adp_path_follower.core.learning.path_learner import ArcLengthLearner
from adp_path_follower.core.learning.weights import Weights
from adp_path_follower.core.learning.weights_file import SavedWeights, difference, problem_settings
from adp_path_follower.core.path.curve import Path, PathFrame
from adp_path_follower.core.path.speed_profile import SpeedProfile, SpeedReference
from adp_path_follower.core.settings.groups import Settings

_MOST_DOUBT = 0.5  # above it, it is the Riccati policy that drives


@dataclass(frozen=True)
class FollowerOutput(ControlOutput):
    """What one control step of `PathFollower` gives.

    Attributes:
        running_cost: e^T Q e + u^T R u, shape (...).
        weights: Critic and actor weights that gave the command, shape (..., L) each.
        measured: Bellman error at the measured state.
        sampled: What the samples say of the weights.
        doubt: Share of the Riccati policy, because the learned value function does not decrease
            here as it must, shape (...).

    """

    running_cost: FloatArray
    weights: Weights
    measured: BellmanErrors
    sampled: Evidence
    doubt: FloatArray

    @property
    def bellman_error(self) -> FloatArray:
        """Return delta at the measured state, shape (...)."""
        return self.measured.error[..., 0]

    @property
    def excitation(self) -> FloatArray | float:
        """Return the certificate of excitation, shape (...)."""
        return self.sampled.excitation


class PathFollower:
    """Follow a path by the policy that is being learned.

    One object drives one robot, or a batch of robots at once: the leading axes of the pose and of
    the arc length are the batch.

    Attributes:
        settings: What it was made with.
        path: The path that it follows.
        profile: The speed along it.
        goal: Whether its end is reached.
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
        """Start at an arc length [m] of the path.

        Args:
            settings: All settings.
            path: The path to follow.
            arc_length: Where the virtual target starts [m], one for each robot of a batch.
            weights: Where the one set of weights of scheduling: path_state starts; by default
                the settings' initial weights.
            actuation: What the robot has been told lately; by default it is at rest.

        """
        self.settings = settings
        self.path = path
        self.profile = SpeedProfile(path, settings)
        self.goal = Goal(path, settings.motion, self.profile.stops)
        self._actuation = actuation if actuation is not None else Actuation()
        self._reference = SpeedReference(self.profile, settings)
        self._target = VirtualTarget(path, settings.target, arc_length, self._reference)
        riccati = RiccatiSchedule(path, settings.target, settings.cost, self.profile)
        self._learner: Learner
        batch, learns = self.arc_length.shape, settings.learning.learning
        if settings.learning.scheduling == "arc_length" and learns and self.arc_length.size > 1:
            self._learner = FleetLearner(settings, path, riccati, self.profile, batch)
        elif settings.learning.scheduling == "arc_length":
            self._learner = ArcLengthLearner(settings, path, riccati, self.profile)
        else:
            self._learner = PathStateLearner(settings, path, riccati, weights, self.profile)
        far_policy = settings.policy.wide_region != "none"
        self._wide_region = WideRegion(settings, riccati) if far_policy else None
        safe_policy = settings.policy.fallback != "none"
        self._fallback = RiccatiPolicy(settings, riccati) if safe_policy else None
        self._distrust = Distrust()
        self._basis = settings.learning.value_basis
        self._running_cost = RunningCost(settings.cost)
        self._inverse_cost = np.asarray(np.linalg.inv(self._running_cost.input_cost), float)
        self.cost = np.zeros_like(self.arc_length)
        self._previous: FollowerOutput | None = None
        self._period = 0.0  # [s] of the last step

    @property
    def arc_length(self) -> FloatArray:
        """Return s_p of the virtual target [m], shape (...)."""
        return self._target.arc_length

    @property
    def weights(self) -> Weights:
        """Return critic and actor weights where the target is, shape (..., L) each."""
        return self._learner.local(self.arc_length).weights

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

        Args:
            pose: Where the robots are.
            dt: Time since the last step.
            learn: False leaves learning to a call of `learn`, before anything else is done.

        """
        elapsed = max(dt, 0.0)  # since the last command, which another follower may have given
        pose = self._actuation.predicted(pose, self.settings.motion.actuation_delay, elapsed)
        if self._previous is None or dt < 0.0:
            dt = 0.0
        if self._previous is None or self._actuation.stopped:
            self._reference.launch(self.arc_length, self._actuation.command[..., 0])
        frame, error = self._target.move(pose, dt)
        output = self._evaluate(frame, error, dt, elapsed)
        self._actuation.send(output.command, self.settings, elapsed)
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
        assert self._previous is not None  # there has been one
        if self.settings.learning.learning:
            self._learner.learn(self._previous.measured, self.arc_length, self._period)

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
        """Learn with robot and target held where they are; return whether the weights settled.

        Args:
            pose: Where the robot is, shape (..., 3).
            distance: How far ahead is learned, where weights change along the path [m].

        """
        self.hold()
        frame, error = self._target.move(pose, 0.0)
        self._target.hold()
        return self._learner.settle(
            lambda: self._evaluate(frame, error, 0.0, 0.0).measured, self.arc_length, distance
        )

    def _evaluate(
        self, frame: PathFrame, error: FloatArray, dt: float, elapsed: float
    ) -> FollowerOutput:
        """Return command, cost and Bellman errors of the present weights.

        Args:
            frame: At the target.
            error: To it, shape (..., 3).
            dt: Time since the last step [s].
            elapsed: Time since the last command [s].

        """
        here = self._situation(frame, error)
        wanted = self._wanted(here)
        learned = applied = saturate(wanted, here.feedforward, self.settings.limits)
        unforced = self._unforced(here)
        running_cost, measured = self._measure(here, unforced, learned)
        doubt = self._doubt(here, running_cost, measured, dt)
        if self._fallback is not None and doubt.any():
            safe = self._fallback.modified_input(here.zeta, here.curvature, here.feedforward)
            applied = applied + doubt[..., None] * (safe - applied)
        if self._wide_region is not None:
            applied = self._wide_region.blend(applied, here.zeta, here.curvature, here.feedforward)
        # Once more, for blending and adding have rounded: -6e-17 is driving backwards.
        wanted = within(applied + here.feedforward, self.settings.limits)
        command = self._actuation.limited(wanted, self.settings, elapsed)
        if command is not wanted and (command != wanted).any():
            applied = command - here.feedforward
        if applied is not learned:
            running_cost, measured = self._measure(here, unforced, applied)
        return FollowerOutput(
            command=command,
            modified_input=applied,
            error=error,
            target_pose=frame.pose,
            arc_length=self.arc_length,
            curvature=frame.curvature,
            running_cost=running_cost,
            weights=here.local.weights,
            measured=measured,
            sampled=self._learner.sampled,
            doubt=doubt,
        )

    def _situation(self, frame: PathFrame, error: FloatArray) -> _Situation:
        """Return what the policy goes by at an error from a frame of the path."""
        target, curvature, v_des = self.settings.target, frame.curvature[()], self._target.v_des
        phi = error_dynamics.path_state(self.arc_length[()], target)
        s, y, theta = numbers(error)
        zeta = components(s, y, theta, phi)
        return _Situation(
            zeta=zeta,
            curvature=curvature,
            v_des=v_des,
            feedforward=error_dynamics.feedforward(curvature, target, v_des),
            heading=(cos(theta), sin(theta)),
            expansion=self._basis.expansion(zeta),
            local=self._learner.local(self.arc_length),
        )

    def _wanted(self, here: _Situation) -> FloatArray:
        """Return the actor's input, without limits, shape (..., 2)."""
        by_s, by_y, by_theta, _ = here.expansion.slope(here.local.weights.actor)
        ahead, aside = here.heading
        descent = components(ahead * by_s + aside * by_y, by_theta)  # g^T sigma'^T Wa
        return descending_input(descent, self._inverse_cost)

    def _unforced(self, here: _Situation) -> _Unforced:
        """Return how state and value change by themselves."""
        target, slope = self.settings.target, here.local.slope
        passing = np.zeros(())[()]
        if slope is not None:  # the value function changes along the path by itself
            speed = error_dynamics.target_speed(here.zeta, target, here.v_des)
            passing = speed * _product(slope, here.expansion.value)
        drift = error_dynamics.drift(here.zeta, here.curvature, target, here.v_des)
        return _Unforced(numbers(drift), passing)

    def _measure(
        self, here: _Situation, unforced: _Unforced, applied: FloatArray
    ) -> tuple[FloatArray, BellmanErrors]:
        """Return the running cost and the Bellman error of an input (..., 2)."""
        running_cost = self._running_cost(here.zeta[..., :3], applied)
        (s_rate, y_rate, turn, phi_rate), (ahead, aside) = unforced.drift, here.heading
        v, w = numbers(applied)
        regressor = here.expansion.rate(
            (s_rate + ahead * v, y_rate + aside * v, turn + w, phi_rate)  # f + g u
        )
        errors = bellman_errors(
            here.local.weights.critic,
            regressor[..., None, :],
            (running_cost + unforced.passing)[..., None],
        )
        return running_cost, errors

    def _doubt(
        self, here: _Situation, running_cost: FloatArray, measured: BellmanErrors, dt: float
    ) -> FloatArray:
        """Return the share of the Riccati policy, from 0 to 1, shape (...)."""
        if self._fallback is None:
            return np.zeros_like(running_cost)
        value = _product(here.local.weights.critic, here.expansion.value)
        safe_value = self._fallback.value(here.zeta, here.curvature, here.v_des)
        doubtful = is_doubtful(measured.error[..., 0], running_cost, value, safe_value)
        return self._distrust.share(doubtful, dt)

    def hold(self) -> None:
        """Let no time pass until the next step: the robot was stopped, or not observed."""
        self._previous = None
        self._target.hold()
        self._distrust.reset()
        self._actuation.stop(forget=True)

    def reset_learning(self, where: np.ndarray | None = None) -> None:
        """Return to the initial weights, of the robots of a batch where (...) is true."""
        self._learner.reset(where)

    def take_over(self, previous: PathFollower) -> None:
        """Take over what another follower has learned, as far as it holds for this one.

        One set of weights for the whole path is kept and learns on. Weights along a path are kept
        while they are those of the same path and problem; of another one, the Riccati solution is
        the better start.
        """
        self._learner.take_over(previous._learner)

    def saved_weights(self) -> SavedWeights:
        """Return what was learned and what it belongs to, for a weights file."""
        return SavedWeights(problem_settings(self.settings), self._learner.learned())

    def start_from(self, saved: SavedWeights) -> str:
        """Go on from the weights of another run; return why they do not hold here, if so."""
        return difference(saved, self.settings) or self._learner.start_from(saved.learned)

    def reconfigured(self, settings: Settings) -> PathFollower:
        """Return a follower with other settings at the same place that has taken over from this."""
        other = PathFollower(settings, self.path, self.arc_length, actuation=self._actuation)
        other.take_over(self)
        other._target = self._target.copy(settings.target, other._reference)
        other.cost, other._previous = self.cost, self._previous
        if self._previous is not None:
            v_des = self._reference.speed(self.arc_length)
            present = self.settings.target.desired_speed if v_des is None else v_des
            other._reference.launch(self.arc_length, np.asarray(present))
        return other
