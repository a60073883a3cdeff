"""Memory of control steps, measured in a process of its own: other threads would count, too.

`python allocations.py lines|growth SETTINGS` prints JSON.
"""

import gc
import json
import math
import sys
import tracemalloc

import numpy as np

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.geometry import advance_pose
from adp_path_follower.core.path.library import circle
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

PERIOD = 10_000_000  # [ns]
LAP = 630  # steps
ROUNDS = 4  # a line that needs memory needs it in each


class Robot:
    """A robot that does what it is told, along a circle."""

    def __init__(self, **values):
        self.driver = Driver(build(Settings, values))
        self.driver.follow(circle(0.5))
        self.pose, self.time = np.array([0.1, 0.1, 1.5]), 0

    def drive(self, steps):
        """Go on for so many steps."""
        for _ in range(steps):
            self.time += PERIOD
            v, w = self.driver.step(self.pose, self.time).command.tolist()
            self.pose = advance_pose(self.pose, v, w, 1e-9 * PERIOD)


def allocated_by_lines(robot, steps):
    """Return the most memory [B] that each line of the package takes at once, by its place."""
    most: dict = {}
    before = tracemalloc.get_traced_memory()[0]
    place = None

    def look(frame, event, argument):
        nonlocal before, place
        present, peak = tracemalloc.get_traced_memory()
        if place is not None:
            most[place] = max(most.get(place, 0), peak - before)
        place = (frame.f_code.co_filename, frame.f_lineno)
        tracemalloc.reset_peak()
        before = present
        return look

    rounds = []
    for _ in range(ROUNDS):
        most.update(dict.fromkeys(most, 0))  # not emptied: a table that grows takes memory, too
        place = None
        sys.settrace(look)
        try:
            robot.drive(steps)
        finally:
            sys.settrace(None)
        rounds.append({k: size for k, size in most.items() if "adp_path_follower" in k[0]})
    lines = set().union(*rounds)
    return {f"{k[0]}:{k[1]}": min(one.get(k, math.inf) for one in rounds) for k in lines}


def most_memory(robot, steps):
    """Return the most memory [B] kept after a step: in a rest it is less than in a sweep."""
    kept = []
    for _ in range(steps):
        robot.drive(1)
        kept.append(tracemalloc.get_traced_memory()[0])
        if len(kept) % 100 == 0:
            gc.collect()
    return max(kept)


def main(kind, values):
    """Print what a robot of some settings takes by lines, or the most, 800 steps apart."""
    robot = Robot(**json.loads(values))
    if kind == "lines":
        robot.drive(LAP)  # the knots of a lap are known from now on
        tracemalloc.start()
        print(json.dumps(allocated_by_lines(robot, 20)))
        return
    robot.drive(LAP + 200)
    tracemalloc.start()  # only now, for it makes a step three times as long
    # Python keeps numbers and tuples for others to come: the first stretch fills their lists.
    # Some fill later, at once and by up to 8 kB, so that 800 steps lie between what is compared.
    print(json.dumps([most_memory(robot, 400) for _ in range(4)][1::2]))


if __name__ == "__main__":
    main(*sys.argv[1:])
