"""Drive a whole lap of the figure eight: `python bench/endurance/lap.py`, about a minute.

The cost between 60 s and 600 s must stay below 1e-4; a lap of 262 s, with all its bends, may have
its share of that. The tests drive a quarter.
"""

from __future__ import annotations

import math

from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.simulation.simulate import simulate

_UNLIMITED = {
    "min_linear_vel": -math.inf,
    "max_linear_vel": math.inf,
    "max_angular_vel": math.inf,
}
_TRANSIENT = 60.0  # [s]


def main() -> int:
    """Print the cost of the lap and its bound; fail if it costs more."""
    path, followers, costs = lissajous(), [], {}

    def make(*arguments: object) -> PathFollower:
        followers.append(PathFollower(*arguments))
        return followers[0]

    def note(runs: object, time: float, pose: object, output: object) -> None:
        costs[round(time, 2)] = float(followers[0].cost[0])

    settings = build(Settings, _UNLIMITED)
    lap = path.length / settings.target.desired_speed
    simulate(settings, path, duration=_TRANSIENT + lap, controller=make, observe=note)
    found, most = max(costs.values()) - costs[_TRANSIENT], 1e-4 * lap / 540.0
    print(f"a lap of {lap:.1f} s costs {found:.3e}, and may cost {most:.3e}")
    return int(not 0.0 < found < most)


if __name__ == "__main__":
    raise SystemExit(main())
