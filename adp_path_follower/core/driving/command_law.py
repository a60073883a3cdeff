"""The control law, from the robot's error to its command, in the order of one control step.

With the paper's symbols (docs/method.md); the paper is arXiv:1310.0064, and equations are
numbered as they are used here:

    (1)  zeta = [s, y, theta, phi],  zeta' = f(zeta) + g(zeta) u,  [v_ss, w_ss] = v_des [1, kappa]
    (2)  u = -1/2 R^-1 g^T sigma'^T Wa                              the actor's input
    (3)  u within the limits less [v_ss, w_ss]                      the constrained minimiser
    (4)  delta = e^T Q e + u^T R u + Wc^T omega,  omega = sigma' (f + g u)       Bellman error
    (5)  doubt where delta or Wc^T sigma breaks its bound           `control.fallback`
    (6)  u moves to the Riccati policy's by doubt, and far from the path to the far policy's;
         a robot that is not ideal is held on the path (`control.near_path`)
    (7)  [v, w] = [v_ss, w_ss] + u within the limits of velocity and acceleration

Weights that change along the path add (dWc/ds_p)^T sigma s_p' to (4), and with them kappa in (1)
is that half a period ahead, as commands are held. Every function broadcasts
over the leading axes (...) of a batch of robots.
"""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.basis import Expansion, Numbers
from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.actuation import Actuation
from adp_path_follower.core.control.cost import RunningCost
from adp_path_follower.core.control.fallback import Fallback
from adp_path_follower.core.control.far_from_path import WideRegion
from adp_path_follower.core.control.near_path import NearPath
from adp_path_follower.core.control.policy import descending_input, saturate, within
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.driving.output import FollowerOutput
from adp_path_follower.core.geometry import FloatArray, Number, components, cos, inner, numbers, sin
from adp_path_follower.core.learning.bellman import BellmanErrors, bellman_errors
from adp_path_follower.core.learning.path_learner import Learner
from adp_path_follower.core.learning.weights import Weights
from adp_path_follower.core.path.curve import PathFrame
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings

_CHANGE_TIME = 1.0  # [s] from one policy far from the path to another


@dataclass(frozen=True)
class Situation:
    """The state of equation (1), and the value function there."""

    zeta: FloatArray  # the state, shape (..., 4)
    curvature: FloatArray  # kappa at the target [1/m], shape (...)
    v_des: Number  # speed along the path there [m/s], shape (...), or one number for all
    feedforward: FloatArray  # [v_ss, w_ss], shape (..., 2)
    heading: Numbers  # cos and sin of the heading error, numbers of shape (...)
    expansion: Expansion  # sigma and sigma'
    weights: Weights  # critic and actor there


class CommandLaw:
    """Turns the error to the virtual target into a command, with the learner's weights."""

    def __init__(
        self,
        settings: Settings,
        riccati: RiccatiSchedule,
        learner: Learner,
        actuation: Actuation,
        profile: SpeedProfile,
        near_path: NearPath | None = None,
    ) -> None:
        """Take Riccati solution, learner, last commands, and the speeds that is learned for."""
        self._settings, self._riccati = settings, riccati
        self._learner, self._actuation = learner, actuation
        self._basis = settings.learning.value_basis
        self._running_cost = RunningCost(settings.cost)
        self._inverse_cost = settings.cost.inverse_input_cost()
        self._wide_region = self._leaving = WideRegion(settings, riccati)
        self._since_change = math.inf  # [s], from the far policy `_leaving` to `_wide_region`
        safe_policy = settings.policy.fallback != "none"
        self._fallback = Fallback(settings, riccati) if safe_policy else None
        self._profile, self._near_path = profile, near_path
        self.robot_is_ideal = True  # whether the robot moves as it is told; else it is held

    def hold(self) -> None:
        """Forget earlier doubt: the next step decides at once which policy drives."""
        if self._fallback is not None:
            self._fallback.reset()

    @property
    def settings(self) -> Settings:
        """Return all settings."""
        return self._settings

    @settings.setter
    def settings(self, settings: Settings) -> None:
        """Go on with others; another policy far from the path takes over without a step."""
        if settings.policy != self._settings.policy:
            self._leaving, self._since_change = self._wide_region, 0.0
            self._wide_region = WideRegion(settings, self._riccati)
        self._settings = settings

    def step(
        self,
        frame: PathFrame,
        error: FloatArray,
        arc_length: FloatArray,
        v_des: Number,
        dt: float,
        coming: FloatArray | None = None,
    ) -> FollowerOutput:
        """Return command, cost and Bellman error of the present weights, equations (1) to (7).

        Takes the path's frame at the target, e = [s, y, theta] in it (..., 3), s_p of the target
        [m] (...), the speed along the path there [m/s] (...), the time since the last step [s], and
        the curvature [1/m] (...) half way through the period for which the command will be held.
        """
        limits = self.settings.limits
        here = self.situation(frame, error, arc_length, v_des, coming)
        learned = saturate(self.actor_input(here), here.feedforward, limits)
        drift, passing = self._unforced(here)
        running_cost, measured = self._bellman_error(here, drift, passing, learned)
        doubt = np.zeros_like(running_cost)
        if self._fallback is not None:
            speed = self._profile.model_speed(arc_length)
            if speed is v_des or not np.any(speed != v_des):
                found = here, learned, running_cost, measured
            else:  # coming from rest, or near the end: judged at the speed that was learned for
                there = self.situation(frame, error, arc_length, speed, coming)
                tried = saturate(self.actor_input(there), there.feedforward, limits)
                found = there, tried, *self._bellman_error(there, *self._unforced(there), tried)
            doubt = self._doubt(self._fallback, *found, dt)
        applied = self._safe_input(here, arc_length, learned, doubt, dt)
        # Within the limits once more, for blending and adding round: -6e-17 m/s is backwards.
        wanted = within(applied + here.feedforward, limits)
        command = self._actuation.limited(wanted, self.settings)
        if command is not wanted and (command != wanted).any():
            applied = command - here.feedforward
        if applied is not learned:
            running_cost, measured = self._bellman_error(here, drift, passing, applied)
        return FollowerOutput(
            command=command,
            modified_input=applied,
            error=error,
            target_pose=frame.pose,
            arc_length=arc_length,
            curvature=frame.curvature,
            running_cost=running_cost,
            weights=here.weights,
            measured=measured,
            sampled=self._learner.sampled,
            doubt=doubt,
        )

    def situation(
        self,
        frame: PathFrame,
        error: FloatArray,
        arc_length: FloatArray,
        v_des: Number,
        coming: FloatArray | None = None,
    ) -> Situation:
        """Return zeta, the feedforward and the value function where the robot is, equation (1)."""
        target, curvature = self.settings.target, frame.curvature
        phi = error_dynamics.path_state(arc_length, target)
        s, y, theta = numbers(error)
        zeta = components(s, y, theta, phi)
        return Situation(
            zeta=zeta,
            curvature=curvature,
            v_des=v_des,
            feedforward=error_dynamics.feedforward(curvature if coming is None else coming, v_des),
            heading=(cos(theta), sin(theta)),
            expansion=self._basis.expansion(zeta),
            weights=self._learner.local(arc_length),
        )

    def actor_input(self, here: Situation) -> FloatArray:
        """Return u = -1/2 R^-1 g^T sigma'^T Wa without limits, shape (..., 2), equation (2)."""
        by_s, by_y, by_theta, _ = here.expansion.slope(here.weights.actor)
        cos_theta, sin_theta = here.heading
        descent = components(cos_theta * by_s + sin_theta * by_y, by_theta)  # g^T sigma'^T Wa
        return descending_input(descent, self._inverse_cost)

    def _unforced(self, here: Situation) -> tuple[Numbers, Number]:
        """Return f of equation (1), four numbers, and (dWc/ds_p)^T sigma s_p', shape (...) each."""
        target, slope = self.settings.target, here.weights.slope
        passing: Number = 0.0
        if slope is not None:
            speed = error_dynamics.target_speed(here.zeta, target, here.v_des)
            passing = speed * inner(slope, here.expansion.value)
        drift = error_dynamics.drift(here.zeta, here.curvature, target, here.v_des)
        return numbers(drift), passing

    def _bellman_error(
        self, here: Situation, drift: Numbers, passing: Number, u: FloatArray
    ) -> tuple[FloatArray, BellmanErrors]:
        """Return the running cost, and delta of an input (..., 2), equation (4)."""
        running_cost = self._running_cost(here.zeta[..., :3], u)
        (s_rate, y_rate, turn, phi_rate), (cos_theta, sin_theta) = drift, here.heading
        v, w = numbers(u)
        omega = here.expansion.rate(
            (s_rate + cos_theta * v, y_rate + sin_theta * v, turn + w, phi_rate)  # f + g u
        )
        cost_rate = (running_cost + passing)[..., None]
        errors = bellman_errors(here.weights.critic, omega[..., None, :], cost_rate)
        return running_cost, errors

    def _doubt(
        self,
        fallback: Fallback,
        here: Situation,
        learned: FloatArray,
        running_cost: FloatArray,
        measured: BellmanErrors,
        dt: float,
    ) -> FloatArray:
        """Return the share of the Riccati policy from 0 to 1, shape (...), equation (5)."""
        value = inner(here.weights.critic, here.expansion.value)
        state = (here.zeta, here.curvature, learned, here.feedforward)
        drives = self._wide_region.share(here.zeta) < 1.0
        return fallback.doubt(measured.error[..., 0], running_cost, value, *state, dt, drives)

    def _safe_input(
        self,
        here: Situation,
        arc_length: FloatArray,
        learned: FloatArray,
        doubt: FloatArray,
        dt: float,
    ) -> FloatArray:
        """Return the input after fallback and far policy, shape (..., 2), equation (6)."""
        place = (here.zeta, here.curvature, here.feedforward)
        applied = learned
        if self._fallback is not None:
            applied = self._fallback.blend(applied, doubt, *place)
        far = self._wide_region.blend(applied, arc_length, *place)
        self._since_change += dt
        if self._since_change < _CHANGE_TIME:
            before = self._leaving.blend(applied, arc_length, *place)
            far = before + self._since_change / _CHANGE_TIME * (far - before)
        if self._near_path is None or self.robot_is_ideal:
            return far
        return self._near_path.held(far, *place)
