"""The stored optimum of the paper's problem, and costs compared with it."""

import json
import math

import numpy as np

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.cost import MotionCost
from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.path.speed_profile import SpeedProfile, speed_from_rest
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.drawing.charts import ReferenceMotion
from adp_path_follower.resources import FORTY_STARTS
from adp_path_follower.study.simulation.simulate import PAPER_START

COST_HORIZON = 30.0  # [s] over which the cost of a run is compared


def paper_optimum() -> ReferenceMotion:
    """Return the optimum from the paper's start, which comes with the package."""
    file = FORTY_STARTS.with_name("paper_optimum.json")
    content = json.loads(file.read_text(encoding="utf-8"))
    return ReferenceMotion(
        cost=float(content["cost"]),
        time=np.array(content["t"]),
        error=np.array(content["e"]),
        modified_input=np.array(content["u"]),
    )


def cost_over_horizon(
    settings: Settings,
    path: Path,
    time: FloatArray,
    poses: FloatArray,
    commands: FloatArray,
    arc_lengths: FloatArray,
) -> float:
    """Return J over the horizon, from each pose along the next command; NaN for a shorter run.

    `settings` give cost and target. The N control steps have the time since the first [s]
    (N,), poses [x, y, theta] (N, 3), commands [v, w] (N, 2) and places of the target [m] (N,).
    """
    if not len(time) or time[-1] < COST_HORIZON - 1e-6:
        return math.nan
    reference = speed_from_rest(path, settings, arc_lengths[0])
    total, motion_cost = 0.0, MotionCost(settings, path, reference)
    for step in np.flatnonzero(time[:-1] < COST_HORIZON - 1e-6):
        spent, _ = motion_cost(
            poses[step],
            commands[step],
            arc_lengths[step],
            float(time[step + 1] - time[step]),
        )
        total += float(spent)
    return total


def is_paper_problem(
    settings: Settings, path: Path, arc_length: float, first_error: FloatArray
) -> bool:
    """Return whether the packaged optimum is that of an error [s, y, theta] at `arc_length` [m]."""
    standard = build(Settings, {})
    same_problem = settings.target == standard.target and settings.cost == standard.cost
    same_problem &= not (settings.motion.limited or SpeedProfile(path, settings).varies)
    place = np.array([arc_length, path.length])
    return bool(
        same_problem
        and _within_limits(paper_optimum(), settings)
        and np.allclose(place, [0.0, lissajous().length], atol=1e-3)
        and np.allclose(first_error, PAPER_START, atol=1e-6)
    )


def _within_limits(optimum: ReferenceMotion, settings: Settings) -> bool:
    """Return whether limits would not have changed an optimum on a straight path."""
    straight, v_des = np.zeros(len(optimum.time)), settings.target.desired_speed
    feedforward = error_dynamics.feedforward(straight, v_des)
    wanted = optimum.modified_input
    return bool(np.allclose(saturate(wanted, feedforward, settings.limits), wanted))
