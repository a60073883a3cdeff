"""The stored optimum of the paper's problem, and costs compared with it."""

import json

import numpy as np

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.path.speed_profile import SpeedProfile
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
