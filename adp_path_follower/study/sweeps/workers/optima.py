"""The cost of the optimum, where it is known: that of the forty starts of the reference."""

import math

import numpy as np

from adp_path_follower.core.files import read_csv_columns
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.resources import FORTY_STARTS
from adp_path_follower.study.sweeps.request.conditions import Conditions, PathSource

_COSTS = FORTY_STARTS.with_name("forty_starts_optimum.csv")
_PATHS = ("lissajous", "line", "circle:0.5", "circle:1.0")
_LONG_ENOUGH = 15.0  # [s], after which J grows by less than 1e-8
WHERE_KNOWN = (
    "J* is known for 'starts: forty' on lissajous, line, circle:0.5 and circle:1.0 from their "
    "beginning, for 15 s and more, with the default cost, speed and target_gain, and without "
    "limits"
)


def optimal_costs(conditions: Conditions, settings: Settings, source: PathSource) -> FloatArray:
    """Return J* of each start, of the ideal robot, shape (B,); NaN where it is not known.

    The cost that counts is that of `conditions`; speed, target and limits are those of `settings`.
    """
    unknown = np.full(len(conditions.starts), math.nan)
    name = _same_name(source.name)
    known = (
        conditions.forty
        and name in _PATHS
        and conditions.run.start_arc_length == 0.0
        and conditions.run.duration >= _LONG_ENOUGH
        and _reference_problem(conditions.settings, settings)
    )
    return read_csv_columns(_COSTS, _PATHS)[:, _PATHS.index(name)] if known else unknown


def _reference_problem(base: Settings, settings: Settings) -> bool:
    standard = build(Settings, {})
    target, motion = settings.target, settings.motion
    return (
        base.cost == standard.cost
        and target.desired_speed == standard.target.desired_speed
        and target.target_gain == standard.target.target_gain
        and settings.limits.unlimited
        and not motion.limited
        and math.isinf(motion.max_lateral_accel)
    )


def _same_name(name: str) -> str:
    """Return the name by which the table has a circle, however its curvature is written."""
    if not name.startswith("circle:"):
        return name
    return f"circle:{float(name.removeprefix('circle:'))}"  # read before as a path
