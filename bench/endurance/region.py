"""Print J/J* far from the path: `python bench/endurance/region.py [CASE...]`, minutes each.

Eight starts of each case, adp warm and NMPC, both beside the offline optimum. J* is that of inputs
that change at any time; adp's are held for 10 ms, and the least that this costs on the path itself
is told too.
"""

from __future__ import annotations

import math
import sys

import numpy as np

from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.resources import config_file
from adp_path_follower.study.comparison import compare as comparison

_STARTS, _SEED = 8, 15
_PERIOD, _PARTS = 0.01, 20  # [s] that adp holds a command, and places in it
_FAR, _FARTHER, _NEAR = (5.0, 5.0, math.pi), (30.0, 30.0, math.pi), (1.0, 1.0, math.pi / 3.0)
_EIGHT, _BEND = ("lissajous", 0.0), ("lissajous", 15.527)
_LINE, _WIDE, _NARROW = ("line", 0.0), ("circle:0.2", 0.0), ("circle:0.5", 0.0)
_TURTLEBOT = config_file("turtlebot4.yaml")
_FREE = ["min_linear_vel=-.inf", "max_linear_vel=.inf", "max_angular_vel=.inf"]
_AT_ONCE = [f"max_{name}=.inf" for name in ("linear_accel", "linear_decel", "angular_accel")]

# Name -> half-widths of the starts, path and place [m], parameters file and changes, time [s].
_CASES = {
    **{
        f"default {path} {place:g}": (_FAR, (path, place), None, [], 40.0)
        for path, place in (_LINE, _WIDE, _NARROW, _EIGHT, _BEND)
    },
    "turtlebot4": (_FAR, _LINE, _TURTLEBOT, _AT_ONCE, 120.0),
    "reverse": (_FAR, _EIGHT, None, ["min_linear_vel=-1.0"], 40.0),
    "unlimited": (_FAR, _EIGHT, None, _FREE, 40.0),
    "far": (_FARTHER, _LINE, None, [], 150.0),
    "cold near": (_NEAR, _EIGHT, None, [], 40.0),
    "cold far": (_FAR, _EIGHT, None, [], 40.0),
    **{  # Faster ones would slow down in bends, which the optimum does not know.
        f"{speed:g} m/s": (_NEAR, _BEND, None, [f"desired_speed={speed}", *limits], 40.0)
        for speed, limits in ((0.1, []), (0.22, []), (1.0, _FREE), (2.0, _FREE), (5.0, _FREE))
    },
}


def main() -> None:
    """Print the chosen cases, all if none is chosen."""
    comparison._LONGEST_LAP = 1.0  # J is all that is looked at
    for name in sys.argv[1:] or _CASES:
        widths, (path_name, place), file, changes, duration = _CASES[name]
        settings = load_settings(Settings, "path_follower", file, changes)
        starts = np.random.default_rng(_SEED).uniform(-1.0, 1.0, (_STARTS, 3)) * widths
        names = ["adp_cold" if name.startswith("cold") else "adp", "nmpc"]
        path = named_path(path_name, settings.path)
        found = comparison.compare(
            settings, path_name, path, starts, names, start_arc_length=place, duration=duration
        )
        ours, peer = found.outcomes
        ahead = float(np.mean(ours.cost <= 1.001 * np.where(peer.failed, math.inf, peer.cost)))
        print(f"{name}: {ahead:.0%} of the starts no dearer than NMPC + 0.1 %")
        for item in found.outcomes:
            shares = " / ".join(f"{item.quantile(share):.4f}" for share in (0.5, 0.95, 1.0))
            print(f"  {item.name:9}{shares}, {int(item.failed.sum())} failed", flush=True)
        held = _held(path, place, settings.target.desired_speed, duration)
        shares = np.quantile((ours.cost - held) / found.optimal_cost, (0.5, 1.0))
        print("  adp less {:.2g}, as commands are held: {:.4f} / {:.4f}".format(held, *shares))
        worst = np.argsort(np.nan_to_num(ours.cost_ratio, nan=math.inf))[-3:]
        for index in worst:
            start, ratio = starts[index].round(3).tolist(), ours.cost_ratio[index]
            print(f"    {start}: J* {found.optimal_cost[index]:.6g}, {ratio:.4f}")
        for text in (*found.problems, *found.notes):
            print(f"    {text}")


def _held(path: Path, place: float, speed: float, duration: float) -> float:
    """Return the least cost of held turn rates for a robot on the path, from a place [m] on."""
    time = (np.arange(round(duration / _PERIOD) * _PARTS) + 0.5) * _PERIOD / _PARTS
    wanted = speed * path.curvature(place + speed * time)
    return float(_PERIOD * wanted.reshape(-1, _PARTS).var(axis=1).sum())  # the mean is best


if __name__ == "__main__":
    main()
