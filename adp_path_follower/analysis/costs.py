"""J of a recorded run, of any controller, and the optimum J* from the same start."""

import json
import math
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid

from adp_path_follower.analysis.recorded_run import Drive
from adp_path_follower.core.control.cost import MotionCost
from adp_path_follower.core.control.error_dynamics import feedforward, target_speed
from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.control.virtual_target import VirtualTarget
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray, pose_in_frame
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.path.progress import new_start
from adp_path_follower.core.path.route import route_of
from adp_path_follower.core.path.speed_profile import SpeedProfile, speed_from_rest
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.resources import FORTY_STARTS
from adp_path_follower.study.optimum.collocation import OptimumSolver
from adp_path_follower.study.optimum.problem import Motion
from adp_path_follower.study.simulation.simulate import PAPER_START

COST_HORIZON = 30.0  # [s] over which the cost of a run is compared
_NOISES = 3.0  # times the cost of the noise from which on J* is none
_LEAST_OPTIMUM = 1e-4  # J* of a start half a centimetre beside the path
_LEAST_RATIO = 0.9  # J / J*: less is no matter of rounding


# cost, optimal_cost and cost_ratio, as far as the bag tells; sentences about them; and the optimal
# motion: time since the first command [s], x, y [m], theta [rad], shape (T, 4).
Costs = tuple[dict[str, float], tuple[str, ...], FloatArray | None]


def costs_of(drive: Drive, settings: Settings | None) -> Costs:
    """Return J of a run, and the optimum from the same start, as far as the bag tells."""
    time = drive.commands.time
    if settings is None:
        return _unknown(
            "the bag does not say with which settings the controller ran; --params gives some to "
            "all bags"
        )
    chosen = (time >= 0.0) & (time <= drive.end)
    if not chosen.any() or drive.end < COST_HORIZON:
        return _unknown(f"the robot was told to move for less than {COST_HORIZON:g} s")
    place = np.searchsorted(drive.odometry.time, time[chosen] + 1e-9, side="right") - 1
    place = np.maximum(place, 0)
    counted = place[time[chosen] < COST_HORIZON]
    if not drive.compared[counted].all():
        return _unknown("the robot's place in the frame of the path is not known all the time")
    numbers = drive.segment_of_pose[counted]
    segment, path = drive.segments[numbers[0]], drive.segments[numbers[0]].path
    if (numbers != numbers[0]).any():
        return _unknown(f"the path changed in the first {COST_HORIZON:g} s")
    if segment.reverse:
        return _unknown("the robot drove backwards")
    time = time[chosen] - time[chosen][0]
    count = int(np.searchsorted(time, COST_HORIZON + 1e-6, side="right")) + 1
    time, poses = time[:count], drive.odometry.values[place[:count], :3]
    start = float(drive.projection.arc_length[place[0]])
    if drive.settings is not None:  # our own controller has its rule
        start = new_start(route_of(path), poses[0], settings.controller).arc_length
    commands = drive.commands.values[chosen][:count]
    cost, arc_length, error = _cost(settings, path, time, poses, commands, start)
    optimum, motion, notes = _optimum(settings, path, arc_length, error)
    weights = settings.cost.state_cost_matrix()
    noise = COST_HORIZON * float(weights[0, 0] + weights[1, 1]) * drive.motion.noise**2
    ratio, doubt = _cost_ratio(cost, optimum, max(_LEAST_OPTIMUM, _NOISES * noise))
    values = {"cost": cost, "optimal_cost": optimum, "cost_ratio": ratio}
    return values, (*notes, *doubt), motion


def _unknown(why: str) -> Costs:
    return {}, (f"no cost: {why}",), None


def _cost_ratio(cost: float, optimum: float, least: float) -> tuple[float, tuple[str, ...]]:
    """Return J / J*, NaN where it would say nothing, and what is to be known about it."""
    if not math.isfinite(cost / optimum if optimum else math.nan):
        return math.nan, ()
    if optimum < least:
        return math.nan, (
            f"no cost_ratio: J* is {optimum:.2g}, of the size of noise; the robot began on its "
            "path",
        )
    ratio = cost / optimum
    if ratio >= 1.0:
        return ratio, ()
    said = f"J is {ratio:.4g} of J*, which no controller can be on the same way"
    if ratio < _LEAST_RATIO:
        return math.nan, (f"no cost_ratio: {said}; the odometry is not what was optimised",)
    return ratio, (f"{said}: sampling and noise of the odometry make the difference",)


def _cost(
    settings: Settings,
    path: Path,
    time: FloatArray,
    poses: FloatArray,
    commands: FloatArray,
    start: float,
) -> tuple[float, float, FloatArray]:
    """Return J over the horizon, NaN for a shorter run; the target's first place and error (3,).

    The N control steps have the time since the first [s] (N,), poses [x, y, theta] (N, 3), along
    which the next commands [v, w] (N, 2) lead. The virtual target starts at an arc length [m].
    """
    target = VirtualTarget(path, settings.target, start, speed_from_rest(path, settings, start))
    _, first = target.move(poses[0], 0.0)
    place = float(target.arc_length)
    total = 0.0 if time[-1] >= COST_HORIZON - 1e-6 else math.nan
    motion_cost = MotionCost(settings, path, speed_from_rest(path, settings, place))
    for step, period in enumerate(np.diff(time).tolist()):
        if time[step] < COST_HORIZON - 1e-6:
            arc_length: Any = np.float64(target.arc_length)  # a number is faster than an array
            spent, *_ = motion_cost(poses[step], commands[step], arc_length, period)
            total += float(spent)
        target.move(poses[step + 1], period)
    return total, place, first


def _optimum(
    settings: Settings, path: Path, arc_length: float, error: FloatArray
) -> tuple[float, FloatArray | None, tuple[str, ...]]:
    """Return J* from a start and the motion it is of, or NaN and why it is not known."""
    motion = known_optimum(settings, path, arc_length, error)
    if motion is None:
        try:
            motion = OptimumSolver(settings, path, arc_length, COST_HORIZON).solve(error).motion
        except AdpError as problem:  # no CasADi, or no optimum found
            return math.nan, None, (f"no J*: {problem}",)
    poses = pose_in_frame(motion.state[:, :3], path.frame(motion.state[:, 3]).pose)
    return motion.cost, np.column_stack([motion.time, poses]), ()


def known_optimum(
    settings: Settings, path: Path, arc_length: float, first_error: FloatArray
) -> Motion | None:
    """Return the packaged optimum, of the paper's problem, if it is that from an error (3,) here.

    The error [s, y, theta] is that to the virtual target at `arc_length` [m].
    """
    file = FORTY_STARTS.with_name("paper_optimum.json")
    content = json.loads(file.read_text(encoding="utf-8"))
    time, error, wanted = (np.array(content[name]) for name in ("t", "e", "u"))
    standard = build(Settings, {})
    same = settings.target == standard.target and settings.cost == standard.cost
    same &= not (settings.motion.limited or SpeedProfile(path, settings).varies)
    # Whether limits would not have changed it on a straight path.
    ahead = feedforward(np.zeros(len(time)), settings.target.desired_speed)
    place = np.array([arc_length, path.length])
    same = (
        same
        and np.allclose(saturate(wanted, ahead, settings.limits), wanted)
        and np.allclose(place, [0.0, lissajous().length], atol=1e-3)
        and np.allclose(first_error, PAPER_START, atol=1e-6)
    )
    if not same:
        return None
    speed = target_speed(error, settings.target, settings.target.desired_speed)
    places = arc_length + cumulative_trapezoid(speed, time, initial=0.0)
    return Motion(float(content["cost"]), time, np.column_stack([error, places]), wanted)
