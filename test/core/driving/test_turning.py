"""Turns on the spot: where poses in one place ask for them, and at the goal."""

import math

import numpy as np
import pytest
from field_routes import case

from adp_path_follower.core.control.actuation import Actuation
from adp_path_follower.core.driving.arrival import turning_command
from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.errors import PathError
from adp_path_follower.core.geometry import advance_pose, wrap_angle
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.schema import build
from sim_unicycle.settings import PlantSettings
from sim_unicycle.unicycle import Unicycle

PERIOD = 10_000_000  # [ns]
LIMITS = {"max_linear_accel": 1.0, "max_linear_decel": 1.0, "max_angular_accel": 3.0}


def driven(route, start, seconds=30.0, stop_after=None, **values):
    """Return poses and commands of an ideal robot to the goal, (N, 3) and (N, 2)."""
    driver = Driver(build(Settings, {"learning": False, **values}))
    driver.follow(route)
    robot, poses, commands = Unicycle(np.asarray(start, float), PlantSettings()), [], []
    for step in range(1, round(seconds * 1e9 / PERIOD)):
        if step == stop_after:
            driver.stopped()
            driver.restart()
        output = driver.command_for(robot.pose, step * PERIOD)
        poses.append(robot.pose)
        commands.append(output.command)
        if driver.at_goal:
            return np.array(poses), np.array(commands)
        robot.step(output.command, 1e-9 * PERIOD)
    raise AssertionError("the goal was not reached")


@pytest.mark.parametrize("limits", [{}, LIMITS])
@pytest.mark.parametrize("stop_after", [None, 330])
def test_a_robot_turns_where_the_poses_turn_and_never_reverses(limits, stop_after):
    route = case("turn_on_the_spot.csv")
    assert [(part.reverse, part.turn_first) for part in route.segments] == [
        (False, False),
        (False, True),
    ]
    poses, commands = driven(route, [0.0, 0.0, 0.0], stop_after=stop_after, **limits)
    assert commands[:, 0].min() >= 0.0
    assert poses[:, 0].max() == pytest.approx(1.0, abs=0.06)  # where it stops by itself
    np.testing.assert_allclose(poses[-1, :2], 0.0, atol=0.06)
    assert abs(wrap_angle(poses[-1, 2] - math.pi)) < 0.1
    turning = (commands[:, 0] == 0.0) & (commands[:, 1] != 0.0)
    assert np.abs(np.diff(poses[turning][:, 2])).sum() > 2.9
    assert np.ptp(poses[turning][:, 0]) < 0.01  # all of it in one place
    if limits and stop_after is None:  # a stop is at once
        assert np.abs(np.diff(commands[turning][:, 1])).max() <= 3.0 * 1e-9 * PERIOD + 1e-9


@pytest.mark.parametrize("place", [0.0, 1.0, 2.0], ids=["begin", "middle", "goal"])
@pytest.mark.parametrize("degrees", [360, -360, 540, -270])
def test_a_robot_turns_as_far_round_as_the_poses_do(place, degrees):
    """In their direction: at the beginning, on the way, and at the goal."""
    x = np.arange(0.0, 2.01, 0.1)
    turned = x > place + 0.01 if place < 2.0 else np.zeros(len(x), dtype=bool)
    spot = round(10.0 * place)
    spin = np.radians(np.arange(0, degrees, math.copysign(90, degrees)))
    along = np.where(turned, 2.0 * place - x, x)
    if degrees % 360 == 0:
        along = x
    headings = np.concatenate([np.zeros(spot), spin, np.full(21 - spot, math.radians(degrees))])
    points = np.zeros((len(headings), 2))
    points[:, 0] = np.concatenate([along[:spot], np.full(len(spin), place), along[spot:]])
    if degrees == -270:  # it goes on to the left
        points[spot + len(spin) :] = np.stack([np.full(21 - spot, place), x[: 21 - spot]], axis=1)
    route = prepare(points, PathSettings(), headings)
    poses, commands = driven(route, [0.0, 0.0, 0.0], **LIMITS)
    turning = (commands[:, 0] == 0.0) & (commands[:, 1] != 0.0)
    rate = commands[turning][:, 1] * 1e-9 * PERIOD
    assert math.degrees(rate.sum()) == pytest.approx(degrees, abs=6.0)
    assert commands[:, 0].min() >= 0.0
    np.testing.assert_allclose(poses[-1, :2], points[-1], atol=0.06)


def test_a_full_turn_that_is_stopped_goes_on():
    spin = np.radians([0, 0, 90, 180, 270, 360, 360])
    points = np.zeros((7, 2))
    points[:, 0] = [0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 2.0]
    route = prepare(points, PathSettings(), spin)
    poses, _ = driven(route, [0.0, 0.0, 0.0], stop_after=500, **LIMITS)
    stopped = poses[499, 2]
    assert 0.9 < stopped < 5.5  # in the turn
    assert np.abs(np.diff(np.unwrap(poses[:, 2]))).sum() < 2.0 * math.pi + 1.0
    np.testing.assert_allclose(poses[-1, :2], [2.0, 0.0], atol=0.06)


def test_the_last_pose_has_a_heading_to_turn_to():
    poses, commands = driven(case("goal_yaw.csv"), [0.0, 0.0, 0.0])
    assert abs(poses[-1, 2] - 2.0) < 0.1
    np.testing.assert_allclose(poses[-1, :2], [1.0, 0.0], atol=0.06)
    assert commands[:, 0].min() >= 0.0
    bare = case("goal_yaw.csv", PathSettings(turn_at_goal=False))
    assert bare.goal_heading is None
    poses, _ = driven(bare, [0.0, 0.0, 0.0])
    assert abs(poses[-1, 2]) < 0.1


@pytest.mark.parametrize(
    "headings",
    [None, np.zeros(21), np.full(21, math.nan), np.append(0.4, np.zeros(20))],
    ids=["none", "identity", "invalid", "the first only"],
)
def test_paths_without_orientations_turn_nowhere(headings):
    line = np.stack([np.zeros(21), np.linspace(0.0, 2.0, 21)], axis=1)
    route = prepare(line, PathSettings(), headings)
    assert route.goal_heading is None
    assert not any(segment.turn_first for segment in route.segments)


def test_planners_that_orient_the_goal_only_are_understood():
    line = np.stack([np.linspace(0.0, 2.0, 21), np.zeros(21)], axis=1)
    assert prepare(line, PathSettings(), np.append(np.zeros(20), -1.2)).goal_heading == -1.2
    along = prepare(line, PathSettings(), np.append(np.zeros(20), 0.04))
    assert along.goal_heading is None  # that is the path's own


def test_a_turn_at_the_first_pose_and_one_of_a_corner():
    points = np.array([[0, 0], [0, 0], [1, 0], [2, 0], [2, 0], [2, 1], [2, 2]], float)
    quarter = 0.5 * math.pi
    headings = np.array([quarter, 0, 0, 0, quarter, quarter, quarter])
    route = prepare(points, PathSettings(), headings)
    assert [segment.turn_first for segment in route.segments] == [True, True]
    np.testing.assert_allclose(route.segments[1].path.frame(0.0).pose, [2, 0, quarter], atol=1e-9)
    poses, commands = driven(route, [0.0, 0.0, quarter])
    assert commands[0, 0] == 0.0  # it faces the path before it leaves
    assert np.abs(poses[poses[:, 0] < 1.8][:, 1]).max() < 0.02
    with pytest.raises(PathError, match="turns on the spot at pose 0"):
        prepare(points, PathSettings(path_closed="closed"), headings)


def test_turns_tell_routes_apart():
    turning = case("turn_on_the_spot.csv")
    assert turning.digest() != case("goal_yaw.csv").digest()
    straight = case("goal_yaw.csv", PathSettings(turn_at_goal=False))
    assert straight.digest() == straight.segments[0].path.digest()
    assert case("goal_yaw.csv").digest() != straight.digest()


@pytest.mark.parametrize("turn", [3.1, -2.0, 0.3])
def test_a_turn_takes_the_time_of_its_limits(turn):
    """At rest, full acceleration, the highest velocity, and back: the closed form, and a tail."""
    settings = build(Settings, {**LIMITS, "max_angular_vel": 1.0})
    actuation, pose, time = Actuation(), np.zeros(3), 0
    while time < 20_000 * PERIOD:
        time += PERIOD
        command = turning_command(turn, pose, time, actuation, settings)
        if command is None:
            break
        assert abs(command[1]) <= 1.0
        pose = advance_pose(pose, *command, 1e-9 * PERIOD)
    assert abs(pose[2] - turn) <= 0.05 + 1e-9
    fastest = abs(turn) / 1.0 + 1.0 / 3.0 if abs(turn) > 1.0 / 3.0 else 2.0 * (turn / 3.0) ** 0.5
    assert fastest - 0.1 <= 1e-9 * time <= fastest + 1.8


@pytest.mark.parametrize("heading", [None, 0.5])
@pytest.mark.parametrize("toward", [0.0, 1.5, math.pi])
def test_a_path_shorter_than_the_tolerance_is_no_way_to_drive(heading, toward):
    """Planners send such ones to a robot at their goal, in any direction and again and again."""
    robot, driver = Unicycle(np.zeros(3), PlantSettings()), Driver(build(Settings, LIMITS))
    driver.follow(prepare([[0.0, 0.0], [2.0, 0.0]], PathSettings()))
    way, commands = np.zeros((2, 2)), []
    for step in range(1, 800):
        if step >= 300 and step % 30 == 0:  # the first one comes at full speed
            way[:] = robot.pose[:2]
            way[1] += 0.02 * np.array([math.cos(toward), math.sin(toward)])
            headings = None if heading is None else np.array([0.0, heading])
            driver.follow(prepare(way, PathSettings(), headings))
        commands.append(driver.command_for(robot.pose, step * PERIOD).command)
        if driver.at_goal:
            break
        robot.step(commands[-1], 1e-9 * PERIOD)
    assert driver.at_goal
    assert np.hypot(*(robot.pose[:2] - way[1])) < 0.05
    assert abs(wrap_angle(robot.pose[2] - (heading or 0.0))) < 0.1  # without one it keeps its own
    changes = np.abs(np.diff(commands[:-1], axis=0))
    assert (changes.max(axis=0) <= np.array([1.0, 3.0]) * 1e-9 * PERIOD + 1e-9).all()
    assert abs(commands[-2][0]) < 0.01


def test_a_route_of_several_segments_within_the_tolerance_is_no_way_to_drive():
    route = prepare(
        [[0.0, 0.0], [0.02, 0.0], [0.0, 0.0]],
        PathSettings(path_tolerance=0.0, allow_reversing=True),
    )
    assert len(route.segments) == 2
    poses, commands = driven(route, [0.0, 0.0, 0.3], min_linear_vel=-0.5, **LIMITS)
    assert not commands.any()
    assert not np.ptp(poses, axis=0).any()
