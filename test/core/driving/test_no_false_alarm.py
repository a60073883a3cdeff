"""Nothing is wrong with the learner of an ideal robot; with garbage for weights something is."""

from __future__ import annotations

import math
import os

import numpy as np
from field_routes import CASES, random_route
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import advance_pose, pose_in_frame
from adp_path_follower.core.path.library import named_path, read_poses
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.schema import build

EXAMPLES = int(os.environ.get("ADP_FALSE_ALARMS", "8"))  # bench: hundreds
PERIOD = 0.02  # [s]


def corners(random):
    """Return a route of straight lines with corners of up to 126 degrees."""
    points, heading = [np.zeros(2)], 0.0
    for _ in range(random.integers(3, 7)):
        ahead = np.array([math.cos(heading), math.sin(heading)])
        points.append(points[-1] + random.uniform(0.5, 4.0) * ahead)
        heading += random.uniform(-2.2, 2.2)
    return prepare(np.array(points), PathSettings())


def shortened(skipped):
    """Return a route with a turn on the spot, begun later than its first pose."""
    poses, _ = read_poses(CASES / "turn_on_the_spot.csv")
    return prepare(poses[skipped:, :2], PathSettings(), poses[skipped:, 2])


def some_route(random):
    kind = random.integers(0, 3)
    if kind == 0:
        return random_route(int(random.integers(0, 24)))
    return corners(random) if kind == 1 else shortened(int(random.integers(0, 5)))


def some_settings(random):
    free = math.inf
    return {
        "learning": bool(random.integers(0, 2)),
        "max_linear_accel": float(random.choice([free, 0.3, 1.0, 2.0])),
        "max_linear_decel": float(random.choice([free, 0.3, 1.0, 2.0])),
        "max_angular_accel": float(random.choice([free, 1.5, 3.0, 6.0])),
        "max_angular_vel": float(random.choice([1.0, 1.5, free])),
        "max_lateral_accel": float(random.choice([free, 0.5])),
        "desired_speed": float(random.choice([0.1, 0.22, 0.5, 1.0])),
    }


def disturbed(driver, random, time):
    """Stop the driver, resume, or limit its speed; return the time of the next step [ns]."""
    kind = random.integers(0, 3)
    if kind == 2:
        limit = float(random.choice([0.1, 0.3, math.inf]))
        driver.take_over(driver.prepared(driver.settings.with_changes(speed_limit=limit)))
        return time
    driver.stopped()
    if kind == 1:
        driver.restart()
    return time + int(random.choice([0, 100_000_000, 3_000_000_000]))


@settings(max_examples=EXAMPLES)
@given(seed=st.integers(0, 10_000))
def test_an_ideal_robot_is_not_doubted(seed):
    """From rest in bends, after sudden stops and resumes in turns, with limits of all kinds."""
    random = np.random.default_rng(seed)
    route, driver = some_route(random), Driver(build(Settings, some_settings(random)))
    driver.follow(route)
    path = route.segments[0].path
    error = random.choice([0.0, 1.0]) * random.uniform([-0.1, -0.2, -0.4], [0.1, 0.2, 0.4])
    start = random.choice([0.0, 0.6]) * random.random() * path.length
    pose, time = pose_in_frame(error, path.frame(start).pose), 0
    for step in range(500):
        output = driver.step(pose, time)
        assert driver.follower.learning_problem == "", (step, output)
        if driver.at_goal:
            break
        pose = advance_pose(pose, *output.command, PERIOD)
        time += round(1e9 * PERIOD)
        if step % 100 == 60:
            time = disturbed(driver, random, time)


def test_a_learner_whose_weights_are_garbage_is_doubted_before_the_robot_is_far_away():
    doubted = [drive_on_garbage(seed) for seed in range(12)]
    assert sum(doubted) >= 11  # one garbage drives as well as any


def drive_on_garbage(seed):
    """Return whether garbage for weights was doubted within two seconds."""
    random = np.random.default_rng(seed)
    path = named_path("circle:0.5")
    follower = PathFollower(build(Settings, {"learning": False}), path)
    error = random.choice([-1.0, 1.0], 3) * random.uniform(0.1, 0.3, 3)
    pose = pose_in_frame(error, path.frame(0.0).pose)
    assert follower.step(pose, PERIOD).doubt == 0.0
    follower.hold()
    knots = follower._learner._knots
    size = np.abs(knots.critic).max()
    knots.critic[:] = size * random.standard_normal(knots.critic.shape[-1])
    knots.actor[:] = size * random.standard_normal(knots.actor.shape[-1])
    problems = set()
    for _ in range(100):
        output = follower.step(pose, PERIOD)
        problems.add(follower.learning_problem)
        assert np.abs(output.error).max() < 0.4
        pose = advance_pose(pose, *output.command, PERIOD)
    return any("does not decrease" in problem for problem in problems)
