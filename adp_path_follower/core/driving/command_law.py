"""The control law, from the robot's error to its command, in the order of one control step.

With the paper's symbols (docs/method.md); the paper is arXiv:1310.0064, and equations are
numbered as they are used here:

    (1)  zeta = [s, y, theta, phi],  zeta' = f(zeta) + g(zeta) u,  [v_ss, w_ss] = v_des [1, kappa]
    (2)  u = -1/2 R^-1 g^T sigma'^T Wa                              the actor's input
    (3)  u within the limits less [v_ss, w_ss]                      the constrained minimiser
    (4)  delta = e^T Q e + u^T R u + Wc^T omega,  omega = sigma' (f + g u)       Bellman error
    (5)  doubt where delta or Wc^T sigma breaks its bound           `control.fallback`
    (6)  u moves to the Riccati policy's by doubt, and far away to that of `control.lookahead`;
         a robot that is not ideal is held on the path (`control.near_path`)
    (7)  [v, w] = [v_ss, w_ss] + u within the limits of velocity and acceleration

Weights that change along the path add (dWc/ds_p)^T sigma s_p' to (4), and with them kappa in (1)
is that half a period ahead, as commands are held. Every function broadcasts
over the leading axes (...) of a batch of robots.
"""

import numpy as np

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.actuation import Actuation
from adp_path_follower.core.control.cost import RunningCost
from adp_path_follower.core.control.fallback import Fallback
from adp_path_follower.core.control.lookahead import FarFromPath
from adp_path_follower.core.control.near_path import NearPath
from adp_path_follower.core.control.policy import descending_input, saturate, within
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.control.virtual_target import VirtualTarget
from adp_path_follower.core.driving.output import FollowerOutput, Situation
from adp_path_follower.core.geometry import FloatArray, Number, components, cos, inner, numbers, sin
from adp_path_follower.core.learning.bellman import BellmanErrors, bellman_errors
from adp_path_follower.core.learning.path_learner import Learner
from adp_path_follower.core.settings.groups import Settings


class CommandLaw:
    """Turns the error to the virtual target into a command, with the learner's weights."""

    def __init__(
        self,
        settings: Settings,
        riccati: RiccatiSchedule,
        learner: Learner,
        actuation: Actuation,
        near_path: NearPath | None = None,
    ) -> None:
        self.settings, self._riccati = settings, riccati
        self._learner, self._actuation = learner, actuation
        self._basis = settings.learning.value_basis
        self._running_cost = RunningCost(settings.cost)
        self._inverse_cost = settings.cost.inverse_input_cost()
        self._far = FarFromPath(settings, riccati)
        self.fallback = Fallback(settings, riccati)
        self._near_path = near_path
        self.robot_is_ideal = True  # whether the robot moves as it is told; else it is held

    def change(self, settings: Settings) -> None:
        """Go on with other settings; another far policy takes over without a step."""
        if settings.policy != self.settings.policy:
            self._far = FarFromPath(settings, self._riccati, self._far)
        self.settings = settings

    def step(
        self, target: VirtualTarget, dt: float, coming: FloatArray | None = None
    ) -> FollowerOutput:
        """Return command, cost and Bellman error of the present weights, equations (1) to (7).

        Takes the target, which has moved to where it is now, the time since the last step [s], and
        the curvature [1/m] (...) half way through the period for which the command will be held.
        """
        here = self.situation(target, target.v_des, coming)
        share, learned = self._far.region.share(here.zeta), None
        if self._far.drives_alone(share):  # whatever was learned
            doubt = self.fallback.undoubted(here.arc_length.shape, dt)
            applied = self._far.far_input(dt, here.arc_length, *here.place)
        else:
            learned = self.actor_input(here)
            running_cost, measured = self._bellman_error(here, learned)
            judged = here, learned, running_cost, measured
            doubt = self._doubt(target, dt, coming, share < 1.0, *judged)
            applied = self.fallback.blend(learned, doubt, *here.place)
            applied = self._far.blend(applied, dt, here.arc_length, *here.place)
        if self._near_path is not None and not self.robot_is_ideal:
            applied = self._near_path.held(applied, *here.place)
        # Within the limits once more, for blending and adding round: -6e-17 m/s is backwards.
        wanted = within(applied + here.feedforward, self.settings.limits)
        command = self._actuation.limited(wanted, self.settings)
        if command is not wanted and (command != wanted).any():
            applied = command - here.feedforward
        if applied is not learned:
            running_cost, measured = self._bellman_error(here, applied)
        return FollowerOutput(
            command=command,
            modified_input=applied,
            error=target.error,
            target_pose=target.frame.pose,
            arc_length=target.arc_length,
            curvature=target.frame.curvature,
            running_cost=running_cost,
            weights=here.weights,
            measured=measured,
            sampled=self._learner.sampled,
            doubt=doubt,
        )

    def situation(
        self, target: VirtualTarget, v_des: Number, coming: FloatArray | None = None
    ) -> Situation:
        """Return zeta, its drift and the value function where the robot is, equation (1)."""
        gains, arc_length, kappa = self.settings.target, target.arc_length, target.frame.curvature
        s, y, theta = numbers(target.error)
        zeta = components(s, y, theta, error_dynamics.path_state(arc_length, gains))
        expansion, weights = self._basis.expansion(zeta), self._learner.local(arc_length)
        passing: Number = 0.0
        if weights.slope is not None:
            speed = error_dynamics.target_speed(zeta, gains, v_des)
            passing = speed * inner(weights.slope, expansion.value)
        return Situation(
            zeta=zeta,
            arc_length=arc_length,
            curvature=kappa,
            feedforward=error_dynamics.feedforward(kappa if coming is None else coming, v_des),
            heading=(cos(theta), sin(theta)),
            drift=numbers(error_dynamics.drift(zeta, kappa, gains, v_des)),
            expansion=expansion,
            weights=weights,
            passing=passing,
        )

    def actor_input(self, here: Situation) -> FloatArray:
        """Return u = -1/2 R^-1 g^T sigma'^T Wa in the limits, (..., 2), equations (2) and (3)."""
        by_s, by_y, by_theta, _ = here.expansion.slope(here.weights.actor)
        cos_theta, sin_theta = here.heading
        descent = components(cos_theta * by_s + sin_theta * by_y, by_theta)  # g^T sigma'^T Wa
        wanted = descending_input(descent, self._inverse_cost)
        return saturate(wanted, here.feedforward, self.settings.limits)

    def _bellman_error(self, here: Situation, u: FloatArray) -> tuple[FloatArray, BellmanErrors]:
        """Return the running cost, and delta of an input (..., 2), equation (4)."""
        running_cost = self._running_cost(here.zeta[..., :3], u)
        (s_rate, y_rate, turn, phi_rate), (cos_theta, sin_theta) = here.drift, here.heading
        v, w = numbers(u)
        omega = here.expansion.rate(
            (s_rate + cos_theta * v, y_rate + sin_theta * v, turn + w, phi_rate)  # f + g u
        )
        cost_rate = (running_cost + here.passing)[..., None]
        errors = bellman_errors(here.weights.critic, omega[..., None, :], cost_rate)
        return running_cost, errors

    def _doubt(
        self,
        target: VirtualTarget,
        dt: float,
        coming: FloatArray | None,
        drives: np.ndarray,
        there: Situation,
        tried: FloatArray,
        rate: FloatArray,
        errors: BellmanErrors,
    ) -> FloatArray:
        """Return the doubt (...) of the input that is tried there, if it drives, equation (5)."""
        speed = self._riccati.profile.model_speed(target.arc_length)
        if speed is not target.v_des and np.any(speed != target.v_des):
            # Coming from rest, or near the end: judged at the speed that was learned for.
            there = self.situation(target, speed, coming)
            tried = self.actor_input(there)
            rate, errors = self._bellman_error(there, tried)
        delta, value = errors.error[..., 0], inner(there.weights.critic, there.expansion.value)
        return self.fallback.doubt(delta, rate, value, tried, drives, dt, *there.place)
