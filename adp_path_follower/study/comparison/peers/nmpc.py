"""Nonlinear model predictive control: the strongest peer.

Needs the extra `optimum` (CasADi).
"""

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path, PathFrame
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.study.comparison.peers.nmpc_solver import STEP, STEPS, Plan, horizon_solver
from adp_path_follower.study.comparison.peers.peer import PeerController

_MOST_PASSES = 3  # of solving again with the curvature where the last pass has the target
_CURVATURE_REACH = 0.05  # [m] to either side that a parabola of curvature is made for
_FARTHEST = 20.0  # [m]: a robot farther away is taken to be there, where solvers still work
_NEAR = 0.5  # [m, rad]: from a plan that is farther away than this, no solver is warm-started
_DECAY = 1.0  # [1/s] of the errors in the first guess


class Nmpc(PeerController):
    """NMPC over 3 s, made for 20 Hz: 30 steps by RK4, Riccati terminal cost, limits as bounds.

    Each step starts from the last plan, shifted. Where the robot is not where it was planned to be,
    or the solver fails, a slower one starts from a plain guess; where that fails, too, the shifted
    plan stands.

    Attributes:
        failures: Number of steps, over all robots, at which no new plan was found.
        solver: Name and way of the fast solver, such as "sqpmethod, compiled".

    """

    def __init__(self, settings: Settings, path: Path, arc_length: ArrayLike = 0.0) -> None:
        """Transcribe and compile the solver; once for all with the same numbers."""
        super().__init__(settings, path, arc_length)
        self._schedule = RiccatiSchedule(path, settings.target, settings.cost)
        self._solver = horizon_solver(settings.target, settings.cost, settings.limits)
        self.solver = self._solver.name
        self.failures = 0
        self._plans: list[Plan | None] = []

    def command(
        self, pose: FloatArray, dt: float, frame: PathFrame, error: FloatArray
    ) -> FloatArray:
        """Return the first command of each robot's plan."""
        away = np.hypot(error[..., 0], error[..., 1])
        nearer = error[..., :2] * (_FARTHEST / np.maximum(away, _FARTHEST))[..., None]
        arc_length = self.target.arc_length[..., None]
        starts = np.concatenate([nearer, error[..., 2:], arc_length], axis=-1)
        flat = starts.reshape(-1, starts.shape[-1])
        if len(self._plans) != len(flat):
            self._plans = [None] * len(flat)
        plans = [
            self._plan(start, None if last is None else last.after(dt))
            for start, last in zip(flat, self._plans, strict=True)
        ]
        self._plans = list(plans)
        commands = np.array([plan.command[0] for plan in plans])
        return commands.reshape(*pose.shape[:-1], 2)

    def _plan(self, start: FloatArray, shifted: Plan | None) -> Plan:
        """Return the plan from [s, y, theta, s_p], shape (4,), given the last one until now."""
        if shifted is not None:
            shifted = shifted.turned_to(start[2])
            if np.abs(shifted.state[0] - start).max() < _NEAR:
                found = self._solve(start, shifted, careful=False)
                if found is not None:
                    return found
        guess = self._guess(start)
        found = self._solve(start, guess, careful=True)
        if found is not None:
            return found
        self.failures += 1
        return guess if shifted is None else shifted

    def _solve(self, start: FloatArray, guess: Plan, careful: bool) -> Plan | None:
        """Return the best plan from a start, with the curvature along that plan itself."""
        for _ in range(_MOST_PASSES):
            places = 0.5 * (guess.state[1:, 3] + guess.state[:-1, 3])
            end = self.path.curvature(guess.state[-1, 3])
            terminal = self._schedule.matrix(end, self.settings.target.desired_speed)
            curvature = self._curvature(places)
            found = self._solver.solve(start, guess, curvature, terminal, careful)
            if found is None:
                return None
            guess = found
            moved = 0.5 * (guess.state[1:, 3] + guess.state[:-1, 3]) - places
            if np.abs(moved).max() < _CURVATURE_REACH:
                break
        return guess

    def _curvature(self, places: FloatArray) -> FloatArray:
        """Return [s_p, kappa, kappa', kappa''] at arc lengths (N,), shape (N, 4)."""
        reach = _CURVATURE_REACH
        behind, here, ahead = self.path.curvature(places + np.array([[-reach], [0.0], [reach]]))
        slope = (ahead - behind) / (2.0 * reach)
        bend = (ahead - 2.0 * here + behind) / reach**2
        return np.column_stack([places, here, slope, bend])

    def _guess(self, start: FloatArray) -> Plan:
        """Return a plan on which the errors die away and the robot just drives on."""
        v_des = self.settings.target.desired_speed
        time = STEP * np.arange(STEPS + 1)
        error = np.exp(-_DECAY * time)[:, None] * start[:3]
        arc_length = start[3] + v_des * time
        turn = v_des * self.path.curvature(arc_length[:-1])
        command = np.column_stack([np.full(STEPS, v_des), turn])
        return Plan(np.column_stack([error, arc_length]), command)
