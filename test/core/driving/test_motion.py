"""Driving with a speed profile and limits: bends, the end of the path, and what is learned."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.riccati import RiccatiSchedule, riccati_solution
from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import advance_pose
from adp_path_follower.core.learning.knot_model import KnotModel
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import circle, lissajous
from adp_path_follower.core.path.nearest import best_place
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.simulation.simulate import simulate

LIMITS = {"max_linear_accel": 1.0, "max_linear_decel": 1.0, "max_angular_accel": 3.2}
SIDE = 3.0  # [m]


def rounded_square(radius):
    """Return a square of 3 m whose corners are quarters of a circle, as a path."""
    points = []
    straight = np.linspace(radius, SIDE - radius, 140)[:-1]
    turn = np.linspace(0.0, 0.5 * math.pi, max(7, math.ceil(80 * radius)))[:-1]
    for corner in range(4):
        heading = 0.5 * math.pi * corner
        ahead = np.array([math.cos(heading), math.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        start = np.array([[0.0, 0.0], [SIDE, 0.0], [SIDE, SIDE], [0.0, SIDE]])[corner]
        centre = start + (SIDE - radius) * ahead + radius * left
        points += [start + along * ahead for along in straight]
        points += [
            centre + radius * (math.sin(angle) * ahead - math.cos(angle) * left) for angle in turn
        ]
    return Path.from_points(points, closed=True)


def distance_to_the_sharp_square(positions):
    """Return the distance from the sides of the square, of positions (N, 2)."""
    over = np.maximum(np.maximum(-positions, positions - SIDE), 0.0)
    outside = np.hypot(over[:, 0], over[:, 1])
    inside = np.minimum(positions, SIDE - positions).min(axis=1)
    return np.where(outside > 0.0, outside, inside)


def drive(path, pose, seconds, values):
    """Return follower, poses (N, 3), commands (N, 2) and outputs of an ideal robot at 100 Hz."""
    place, _ = best_place(path, np.asarray(pose))
    follower = PathFollower(build(Settings, values), path, place)
    pose, poses, outputs = np.asarray(pose, float), [], []
    for _ in range(round(seconds * 100)):
        outputs.append(follower.step(pose, 0.01))
        poses.append(pose)
        pose = advance_pose(pose, *outputs[-1].command, 0.01)
    commands = np.array([output.command for output in outputs])
    return follower, np.array(poses), commands, outputs


@pytest.mark.parametrize("radius", [0.1, 0.14])
def test_the_square_is_driven_within_six_centimetres(radius):
    """Both ways: the robot from the sides of the square, and its corners from the robot."""
    path = rounded_square(radius)
    _, poses, commands, _ = drive(path, (0.5, 0.0, 0.0), 28.0, {**LIMITS, "max_angular_vel": 1.8})
    assert distance_to_the_sharp_square(poses[:, :2]).max() <= 0.06
    for corner in [(SIDE, 0.0), (SIDE, SIDE), (0.0, SIDE)]:
        assert np.hypot(*(poses[:, :2] - corner).T).min() <= 0.06
    rates = np.abs(np.diff(commands, axis=0)) * 100.0
    assert rates[:, 0].max() <= 1.0 + 1e-9
    assert rates[:, 1].max() <= 3.2 + 1e-9
    assert np.abs(commands[:, 1]).max() <= 1.8


@pytest.mark.parametrize("limits", [{}, LIMITS], ids=["default", "accelerations"])
def test_a_square_given_by_its_corners_is_driven_within_six_centimetres(limits):
    """Its corners are rounded within the path tolerance of 5 cm; 1 cm is left for the robot."""
    corners = np.array([[0.0, 0.0], [SIDE, 0.0], [SIDE, SIDE], [0.0, SIDE], [0.0, 0.0]])
    values = {**limits, "max_angular_vel": 1.8}
    (segment,) = prepare(corners, build(Settings, values).path).segments
    _, poses, commands, _ = drive(segment.path, (0.5, 0.0, 0.0), 32.0, values)
    assert distance_to_the_sharp_square(poses[:, :2]).max() <= 0.06
    for corner in corners[1:4]:
        assert np.hypot(*(poses[:, :2] - corner).T).min() <= 0.06
    assert np.abs(commands[:, 1]).max() <= 1.8
    assert commands[:, 0].max() == pytest.approx(0.5, abs=0.01)


def test_an_open_path_ends_in_standing_within_the_tolerances():
    bend = [[2.0 + math.sin(a), 1.0 - math.cos(a)] for a in np.linspace(0.0, 1.5, 40)]
    path = Path.from_points([*([x, 0.0] for x in np.linspace(0.0, 1.95, 40)), *bend])
    end = path.frame(path.length).pose
    random = np.random.default_rng(0)
    for start in random.uniform([-0.4, -0.4, -1.0], [0.4, 0.4, 1.0], (6, 3)):
        driver, pose, time, commands = Driver(build(Settings, LIMITS)), start, 0, [np.zeros(2)]
        driver.follow(path)
        while not driver.at_goal:
            time += 10_000_000
            assert time < 60e9
            output = driver.step(pose, time)
            pose = advance_pose(pose, *output.command, 0.01)
            commands.append(output.command)
        assert np.hypot(*(pose - end)[:2]) <= 0.05
        assert abs(math.remainder(pose[2] - end[2], math.tau)) <= 0.1
        assert abs(commands[-1][0]) <= 0.02
        rates = np.abs(np.diff(commands, axis=0)) * 100.0
        assert rates[:, 0].max() <= 1.0 + 1e-9
        assert rates[:, 1].max() <= 3.2 + 1e-9


def test_a_robot_that_stands_beside_the_end_is_told_of():
    path = Path.from_points([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]])
    driver = Driver(build(Settings, LIMITS))
    driver.follow(path)
    beside = np.array([1.0, 0.3, 0.0])  # with no way left to come nearer
    for step in range(1, 1300):
        driver.step(beside, step * 10_000_000)
        assert not driver.at_goal
        assert driver.follower is not None
        if driver.follower.goal.problem:
            break
    assert "0.300 m" in driver.follower.goal.problem
    assert "xy_goal_tolerance 0.05" in driver.follower.goal.problem
    assert 9.0 < step * 0.01 < 12.5


def goal_without_braking(places):
    """Return the goal of a line of 1 m after a robot was at places x [m] and y = 0.02, y = ..."""
    path = Path.from_points([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]])
    driver = Driver(build(Settings, {"path_start": "beginning"}))
    driver.follow(path)
    for step, (x, y) in enumerate(places, start=1):
        driver.step(np.array([x, y, 0.0]), step * 10_000_000)
    assert driver.follower is not None
    return driver.follower.goal


@pytest.mark.parametrize(
    ("x", "y", "reached", "problem"),
    [
        (np.linspace(0.0, 1.1, 221), 0.02, True, ""),
        (np.linspace(-0.2, 0.9, 221), 0.0, False, ""),  # behind its target, on its way
        (np.linspace(-0.2, 1.1, 261), 0.0, True, ""),
        (np.linspace(0.0, 1.1, 221), 0.06, False, "from the end of the path"),  # passes by
        (np.zeros(1300), 0.0, False, "1.000 m and 0.000 rad"),  # is held
    ],
)
def test_without_deceleration_the_robot_must_come_by_the_end(x, y, reached, problem):
    goal = goal_without_braking([(place, y) for place in x])
    assert bool(goal.reached) == reached
    assert problem in goal.problem
    assert bool(goal.problem) == bool(problem)
    assert not problem or "max_linear_decel" in goal.problem


def test_without_deceleration_the_goal_is_where_the_path_ends():
    path = Path.from_points([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]])
    follower, *_ = drive(path, (0.5, 0.02, 0.0), 1.2, {})
    assert bool(follower.goal.reached)
    follower, *_ = drive(path, (0.5, 0.02, 0.0), 0.8, {})
    assert not bool(follower.goal.reached)


def test_the_robot_keeps_to_the_profile_once_it_is_on_the_path():
    values = {**LIMITS, "max_lateral_accel": 0.1}
    path = lissajous()
    start = path.frame(11.0).pose
    follower, _, commands, outputs = drive(path, start, 20.0, values)
    planned = follower.profile.speed(np.array([output.arc_length for output in outputs]))
    assert planned.min() < 0.3 < 0.49 < planned.max()
    assert (commands[:, 0] - planned)[300:].max() <= 0.02  # [m/s] for corrections
    errors = np.array([output.error for output in outputs])
    assert np.abs(errors[300:, 1]).max() < 0.005


def test_a_speed_profile_is_learned_with_as_little_cost_as_a_constant_speed():
    """Corrections on a bend that is braked for cost what they cost at the speed of the bend."""
    starts = np.array([[-0.3, 0.2, 0.2], [0.2, -0.3, -0.4], [0.0, 0.25, 0.0]])
    run = {"learning": "warm", "duration": 8.0, "rate": 25.0}
    braked = simulate(build(Settings, {"max_lateral_accel": 0.04}), circle(1.0), starts, **run)
    slow = simulate(build(Settings, {"desired_speed": 0.2}), circle(1.0), starts, **run)
    np.testing.assert_allclose(braked.cost, slow.cost, rtol=2e-3)


# --- the model at another speed -----------------------------------------------------------------


@pytest.mark.parametrize("speed", [0.05, 0.3, 0.5])
def test_the_model_of_a_knot_is_that_of_its_speed(speed):
    values = {"sample_count": 64, "basis_degree": 3}
    knots = KnotModel(build(Settings, values), 0.2, varies=True)
    other = KnotModel(build(Settings, {**values, "desired_speed": speed}), 0.2)
    ahead = np.random.default_rng(3).normal(
        size=len(build(Settings, values).learning.value_basis.labels)
    )
    found = knots.equations(slice(None), ahead, 0.7, speed)
    expected = other.equations(slice(None), ahead, 0.7, speed)
    np.testing.assert_allclose(found.matrix, expected.matrix, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(found.vector, expected.vector, rtol=1e-10, atol=1e-10)


def test_the_error_dynamics_with_a_speed_are_those_of_that_speed():
    random = np.random.default_rng(4)
    zeta, kappa, speed = (
        random.normal(size=(20, 4)),
        random.normal(size=20),
        random.uniform(0, 1, 20),
    )
    target = build(Settings, {}).target
    for index in range(20):
        own = build(Settings, {"desired_speed": float(speed[index])}).target
        one = zeta[index], kappa[index]
        np.testing.assert_allclose(
            error_dynamics.drift(zeta, kappa, target, speed)[index],
            error_dynamics.drift(*one, own, own.desired_speed),
            atol=1e-14,
        )
        np.testing.assert_allclose(
            error_dynamics.feedforward(kappa, speed)[index],
            error_dynamics.feedforward(one[1], own.desired_speed),
            atol=1e-14,
        )


def test_the_riccati_solution_is_that_of_curvature_and_speed():
    path, tuning = lissajous(), build(Settings, {"max_lateral_accel": 0.05})
    profile = SpeedProfile(path, tuning)
    schedule = RiccatiSchedule(path, tuning.target, tuning.cost, profile)
    for kappa in (-1.0, -0.3, 0.0, 0.62):
        for speed in (profile.slowest, 0.1, 0.22, 0.5):
            found = schedule.matrix(np.asarray(kappa), np.asarray(speed))
            expected = riccati_solution(kappa, speed, tuning.target, tuning.cost)
            np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.02)
