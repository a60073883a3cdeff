"""The path follower: poses in, commands out. Nodes, simulation and replay share this object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core import error_dynamics
from adp_path_follower.core.bellman import (
    BellmanErrors,
    SampledModel,
    excitation,
    measured_error,
)
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learner import Weights, update_weights
from adp_path_follower.core.path import Path, PathFrame
from adp_path_follower.core.policy import actor_input, saturate
from adp_path_follower.core.settings import Settings


@dataclass(frozen=True)
class FollowerOutput:
    """What one control step gives; arrays have the leading axes of the pose.

    Attributes:
        command: [v, w] to apply [m/s, rad/s], shape (..., 2).
        modified_input: u = [v_e, w_e], the command less its feedforward, shape (..., 2).
        error: e = [s, y, theta] [m, m, rad], shape (..., 3).
        target_pose: Pose of the virtual target, shape (..., 3).
        arc_length: s_p [m], shape (...).
        curvature: kappa at the target [1/m], shape (...).
        running_cost: e^T Q e + u^T R u, shape (...).
        weights: Critic and actor weights that gave the command, shape (..., L) each.
        measured: Bellman error at the measured state.
        sampled: Bellman errors at the sampled states.

    """

    command: FloatArray
    modified_input: FloatArray
    error: FloatArray
    target_pose: FloatArray
    arc_length: FloatArray
    curvature: FloatArray
    running_cost: FloatArray
    weights: Weights
    measured: BellmanErrors
    sampled: BellmanErrors

    @property
    def bellman_error(self) -> FloatArray:
        """Return delta at the measured state, shape (...)."""
        return self.measured.error[..., 0]

    @property
    def excitation(self) -> FloatArray:
        """Return the smallest singular value of the rank condition's matrix, shape (...)."""
        return excitation(self.sampled.information)


class PathFollower:
    """Follow a path by the policy that is being learned.

    One object drives one robot, or a batch of robots at once: the leading axes of the pose, of
    the arc length and of the weights are the batch.

    Attributes:
        settings: What it was made with.
        path: The path that it follows.
        arc_length: s_p of the virtual target [m], shape (...).
        weights: Critic and actor weights, shape (..., L) each.
        cost: J so far, by the trapezoidal rule over the control steps, shape (...).

    """

    def __init__(
        self,
        settings: Settings,
        path: Path,
        arc_length: ArrayLike = 0.0,
        weights: Weights | None = None,
    ) -> None:
        """Start at an arc length [m] of the path, with the settings' weights by default."""
        self.settings = settings
        self.path = path
        self.arc_length = np.asarray(arc_length, dtype=float)
        self.weights = Weights.initial(settings.learning) if weights is None else weights
        self._model = SampledModel(settings, path)
        self._state_cost = settings.cost.state_cost_matrix()
        self._input_cost = settings.cost.input_cost_matrix()
        self._input_cost_inverse = np.asarray(np.linalg.inv(self._input_cost), float)
        self.cost = np.zeros_like(self.arc_length)
        self._previous: FollowerOutput | None = None
        self._time: int | None = None

    def step(self, pose: FloatArray, dt: float) -> FollowerOutput:
        """Return the command for a pose [x, y, theta], shape (..., 3), after dt [s].

        Moves the virtual target over the past period, computes error and command there, then
        learns for one period. The first step, and the first one after `hold`, lets no time pass.
        """
        if self._previous is None or dt < 0.0:
            dt = 0.0
        if self.arc_length.shape != pose.shape[:-1]:  # one start for a batch
            self.arc_length = np.broadcast_to(self.arc_length, pose.shape[:-1])
        frame, error = self._move_target(pose, dt)
        output = self._evaluate(frame, error)
        if self._previous is not None:
            mean_rate = 0.5 * (self._previous.running_cost + output.running_cost)
            self.cost = self.cost + dt * mean_rate
        self._previous = output
        if self.settings.learning.learning and dt > 0.0:
            self._learn(output, dt)
        return output

    def step_at(self, pose: FloatArray, time: int) -> FollowerOutput:
        """Return the command for a pose at a time [ns] of any clock.

        Like `step` with the time since the last call. After a gap longer than `odom_timeout`, and
        after a step back of the clock, no time passes: nobody knows what the robot did meanwhile.
        """
        elapsed = 0.0 if self._time is None else (time - self._time) * 1e-9
        if not 0.0 < elapsed <= self.settings.controller.odom_timeout:
            self.hold()
        self._time = time
        return self.step(pose, elapsed)

    def learn_at_rest(self, pose: FloatArray, seconds: float = 600.0) -> bool:
        """Learn with robot and target held where they are; return whether the weights settled.

        Args:
            pose: Where the robot is, shape (..., 3).
            seconds: The most learning time that is spent.

        """
        frame, error = self._move_target(pose, 0.0)
        step = 0.1
        for _ in range(round(seconds / step)):
            before = self.weights
            self._learn(self._evaluate(frame, error), step)
            change = np.abs(self.weights.critic - before.critic).max()
            change = max(change, np.abs(self.weights.actor - before.actor).max())
            if change < 1e-9:
                return True
        return False

    def _evaluate(self, frame: PathFrame, error: FloatArray) -> FollowerOutput:
        """Return command, cost and Bellman errors of the present weights at an error."""
        target = self.settings.target
        phi = error_dynamics.path_state(self.arc_length, target)
        zeta = np.concatenate([error, phi[..., None]], axis=-1)
        gradient = self.settings.learning.value_basis.gradient(zeta)
        input_matrix = error_dynamics.input_matrix(zeta)
        feedforward = error_dynamics.feedforward(frame.curvature, target)
        input_gradient = np.matmul(gradient, input_matrix)
        wanted = actor_input(self.weights.actor, input_gradient, self._input_cost_inverse)
        applied = saturate(wanted, feedforward, self.settings.limits)
        running_cost = self.running_cost(error, applied)
        drift = error_dynamics.drift(zeta, frame.curvature, target)
        zeta_rate = drift + np.matmul(input_matrix, applied[..., None])[..., 0]
        return FollowerOutput(
            command=applied + feedforward,
            modified_input=applied,
            error=error,
            target_pose=frame.pose,
            arc_length=self.arc_length,
            curvature=frame.curvature,
            running_cost=running_cost,
            weights=self.weights,
            measured=measured_error(self.weights.critic, gradient, zeta_rate, running_cost),
            sampled=self._model.sweep(self.weights.critic, self.weights.actor),
        )

    def _learn(self, output: FollowerOutput, dt: float) -> None:
        self.weights = update_weights(
            self.weights, output.measured, output.sampled, self.settings.learning, dt
        )

    def running_cost(self, error: FloatArray, modified_input: FloatArray) -> FloatArray:
        """Return e^T Q e + u^T R u, shape (...)."""
        state = (error @ self._state_cost * error).sum(axis=-1)
        control = (modified_input @ self._input_cost * modified_input).sum(axis=-1)
        return np.asarray(state + control)

    def hold(self) -> None:
        """Let no time pass until the next step: the robot was stopped, or not observed."""
        self._previous = None

    def reset_learning(self) -> None:
        """Return to the initial weights of the settings."""
        self.weights = Weights.initial(self.settings.learning)

    def reconfigured(self, settings: Settings) -> PathFollower:
        """Return a follower with other settings at the same place, keeping what was learned."""
        same_basis = settings.learning.basis == self.settings.learning.basis
        weights = self.weights if same_basis else None
        other = PathFollower(settings, self.path, self.arc_length, weights)
        other.cost, other._previous, other._time = self.cost, self._previous, self._time
        return other

    def _move_target(self, pose: FloatArray, dt: float) -> tuple[PathFrame, FloatArray]:
        """Move the virtual target over the past period; return its frame and the error there.

        Heun's method: s_p' is taken at both ends of the period, where the robot was observed.
        """
        if self._previous is None or dt <= 0.0:
            frame = self.path.frame(self.arc_length)
            return frame, error_dynamics.tracking_error(pose, frame.pose)
        target = self.settings.target
        speed_before = error_dynamics.target_speed(self._previous.error, target)
        guess = self.arc_length + dt * speed_before
        error = error_dynamics.tracking_error(pose, self.path.frame(guess).pose)
        speed_after = error_dynamics.target_speed(error, target)
        self.arc_length = self.arc_length + 0.5 * dt * (speed_before + speed_after)
        frame = self.path.frame(self.arc_length)
        return frame, error_dynamics.tracking_error(pose, frame.pose)
