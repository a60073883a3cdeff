"""Follow a path of your own: points in, a simulated run out. `python examples/own_path.py`."""

import sys

import numpy as np

import adp_path_follower as adp


def main(duration: float = 30.0) -> None:
    """Drive along a slalom, from three starts beside it."""
    x = np.linspace(0.0, 12.0, 60)
    path = adp.path(np.column_stack([x, np.sin(x)]))
    settings = adp.load_settings("default", desired_speed=0.4, max_lateral_accel=0.3)
    starts = [[0.0, 0.3, 0.0], [0.0, -0.3, 0.5], [-0.2, 0.0, -0.8]]
    found = adp.simulate(path, settings, starts=starts, duration=duration)
    print(path)
    print(found)
    print("J of each start:", found.cost.round(4).tolist())


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
