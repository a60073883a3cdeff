"""A control step keeps no memory that grows, and the policy takes nothing large."""

import gc
import math
import sys
import tracemalloc

import numpy as np
import pytest

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
    # The rest of the process, such as another thread, is counted too, but not in every round.
    lines = set().union(*rounds)
    return {line: min(found.get(line, math.inf) for found in rounds) for line in lines}


@pytest.fixture
def traced():
    tracemalloc.start()
    yield
    tracemalloc.stop()


def test_no_line_of_the_policy_takes_more_than_4_kb(traced):
    robot = Robot(learning=False)
    robot.drive(LAP)  # the knots of a lap are known from now on
    found = allocated_by_lines(robot, 20)
    assert len(found) > 100
    assert max(found.values()) > 2000  # the basis: four rows of 80 numbers
    assert {place: size for place, size in found.items() if size > 4096} == {}


def most_memory(robot, steps):
    """Return the most memory [B] kept after a step: in a rest it is less than in a sweep."""
    kept = []
    for _ in range(steps):
        robot.drive(1)
        kept.append(tracemalloc.get_traced_memory()[0])
        if len(kept) % 100 == 0:
            gc.collect()
    return max(kept)


@pytest.mark.parametrize("values", [{}, {"learning": False}, {"scheduling": "path_state"}])
def test_memory_does_not_grow_with_time(traced, values):
    robot = Robot(**values)
    robot.drive(LAP + 200)
    most = [most_memory(robot, 300) for _ in range(4)]
    # Less than a float, and its place in a list, for each step. Threads of other tests may take
    # memory meanwhile, but not each time.
    assert min(np.diff(most)) < 300 * 16
