"""Driving routes of several segments, forwards and backwards, with the ideal unicycle."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.driving.arrival import Standstill
from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.geometry import tracking_error
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.path.route import Route, Segment, turned_settings
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.schema import build, update
from sim_unicycle.settings import PlantSettings
from sim_unicycle.unicycle import Unicycle

HALF_TURN = np.array([0.0, 0.0, math.pi])
PERIOD = 10_000_000  # [ns]
REVERSING = build(
    Settings, {"allow_reversing": True, "min_linear_vel": -0.4, "path_start": "beginning"}
)
TURNS = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.2], [1.0, 0.6], [0.0, 0.6]]


def wave(length=3.0):
    x = np.linspace(0.0, length, 80)
    return np.stack([x, 0.3 * np.sin(2.0 * x)], axis=1)


def drive(driver, pose, steps, stop_at_goal=True):
    """Return poses and outputs of a robot that does what it is told."""
    robot = Unicycle(np.array(pose, dtype=float), PlantSettings())
    poses, outputs, segments = [], [], []
    for step in range(steps):
        poses.append(robot.measured_pose())
        outputs.append(driver.step(poses[-1], (step + 1) * PERIOD))
        segments.append(driver.segment)
        robot.step(outputs[-1].command, 1e-9 * PERIOD)
        if driver.at_goal and stop_at_goal:
            break
    return np.array(poses), outputs, np.array(segments)


def test_backwards_is_forwards_for_a_robot_that_faces_the_other_way():
    path = Path.from_points(wave())
    start = np.array([0.1, -0.1, 0.4])
    ahead = Driver(update(turned_settings(REVERSING), {"allow_reversing": False}))
    ahead.follow(path)
    back = Driver(REVERSING)
    back.follow(Route((Segment(path, reverse=True),)))
    expected, there, _ = drive(ahead, start, 300)
    found, here, _ = drive(back, start + HALF_TURN, 300)
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.cos(found[:, 2] - expected[:, 2]), -1.0, atol=1e-9)
    for mine, other in zip(here, there, strict=True):
        np.testing.assert_allclose(mine.command, other.command * [-1.0, 1.0], atol=1e-9)
        assert mine.running_cost == pytest.approx(other.running_cost, abs=1e-9)


def test_outputs_in_reverse_are_those_of_the_real_robot():
    driver = Driver(REVERSING)
    driver.follow(Route((Segment(Path.from_points(wave()), reverse=True),)))
    poses, outputs, _ = drive(driver, [0.0, 0.2, math.pi], 400)
    for pose, output, after in zip(poses, outputs, outputs[1:], strict=False):
        np.testing.assert_allclose(
            output.error, tracking_error(pose, output.target_pose), atol=1e-9
        )
        assert -0.4 - 1e-12 <= output.command[0] <= 1.0
        feedforward = output.command - output.modified_input
        assert feedforward[0] == pytest.approx(-0.4)  # v_ss, of the speed in reverse
        halfway = 0.5 * (output.curvature + after.curvature)  # while the command is held
        assert feedforward[1] == pytest.approx(feedforward[0] * halfway, abs=2e-4)
    assert np.hypot(*outputs[-1].error[:2]) < 0.05


def test_a_route_is_driven_segment_by_segment_with_a_stop_between():
    route = prepare(TURNS, PathSettings(allow_reversing=True))
    assert [segment.reverse for segment in route.segments] == [False, True]
    driver = Driver(REVERSING)
    driver.follow(route)
    poses, outputs, segments = drive(driver, [0.0, 0.0, 0.0], 2500)
    assert driver.at_goal
    assert np.flatnonzero(np.diff(segments)).size == 1
    change = int(np.argmax(segments))
    commands = np.array([output.command for output in outputs])
    assert (commands[: change - 30, 0] > 0.0).all()
    assert (commands[change - 15 : change] == 0.0).all()
    assert np.linalg.norm(np.diff(poses[change - 15 : change], axis=0)) == 0.0
    assert (commands[change + 20 :, 0] < 0.0).all()
    np.testing.assert_allclose(poses[-1, :2], TURNS[-1], atol=0.1)
    assert abs(math.remainder(poses[-1, 2], math.tau)) < 0.15  # it has backed in


def test_the_goal_is_the_end_of_the_last_segment_only():
    driver = Driver(REVERSING)
    driver.follow(prepare(TURNS, PathSettings(allow_reversing=True)))
    _, outputs, segments = drive(driver, [0.0, 0.0, 0.0], 2500, stop_at_goal=False)
    assert not any(np.isnan(output.command).any() for output in outputs)
    assert segments[-1] == 1


def test_the_nearest_place_of_a_route_goes_by_the_robots_heading():
    line = np.stack([np.linspace(0.0, 2.0, 41), np.zeros(41)], axis=1)
    route = prepare(np.vstack([line, line[::-1][1:]]), PathSettings(allow_reversing=True))
    headed = np.array([1.0, 0.0, 0.0])
    assert route.nearest(headed)[0] in (0, 1)  # it may drive either way with this heading
    away = Route((Segment(Path.from_points(line)), Segment(Path.from_points(line[::-1]))))
    assert away.nearest(headed) == (0, pytest.approx(1.0, abs=0.011))
    assert away.nearest(headed + HALF_TURN) == (1, pytest.approx(1.0, abs=0.011))
    in_reverse = Route((Segment(Path.from_points(line), reverse=True),))
    assert in_reverse.points(0.5)[0, 2] == pytest.approx(math.pi)


def test_digests_tell_routes_apart():
    path = Path.from_points(wave())
    routes = [
        Route((Segment(path),)),
        Route((Segment(path, reverse=True),)),
        Route((Segment(path), Segment(path, reverse=True))),
        Route((Segment(path, reverse=True), Segment(path))),
    ]
    assert routes[0].digest() == path.digest()
    assert len({route.digest() for route in routes}) == len(routes)


def test_reversing_needs_a_speed_for_it():
    with pytest.raises(SettingsError, match="'allow_reversing' is true, but 'min_linear_vel' is 0"):
        build(Settings, {"allow_reversing": True})
    driver = Driver(REVERSING)
    driver.follow(prepare(TURNS, PathSettings(allow_reversing=True)))
    driver.step(np.zeros(3), PERIOD)
    with pytest.raises(SettingsError, match="the present path is driven backwards"):
        driver.take_over(
            driver.prepared(update(REVERSING, {"allow_reversing": False, "min_linear_vel": 0.0}))
        )
    assert driver.settings == REVERSING


def test_settings_change_on_a_segment_in_reverse():
    driver = Driver(REVERSING)
    driver.follow(Route((Segment(Path.from_points(wave()), reverse=True),)))
    drive(driver, [0.0, 0.0, math.pi], 50)
    driver.take_over(driver.prepared(update(REVERSING, {"min_linear_vel": -0.2})))
    _, outputs, _ = drive(driver, [0.2, 0.1, math.pi], 50)
    assert min(output.command[0] for output in outputs) >= -0.2 - 1e-12


@settings(max_examples=50)
@given(
    speed=st.floats(0.0, 1.0),
    turn=st.floats(-1.0, 1.0),
    step=st.integers(5_000_000, 100_000_000),
)
def test_a_robot_stands_still_when_it_does_not_move(speed, turn, step):
    standstill = Standstill()
    rested = []
    for number in range(60):
        time = number * step
        pose = np.array([1e-9 * time * speed, 1.0, 1e-9 * time * turn])
        rested.append((time, standstill.reached(pose, time)))
    early = [time for time, found in rested if found and time < 2_000_000_000]
    if speed > 0.03 or abs(turn) > 0.06:
        assert not early
    if speed < 0.01 and abs(turn) < 0.02 and rested[-1][0] > 500_000_000:
        assert min(early) <= 200_000_000 + step
    assert all(found for time, found in rested if time >= 2_000_000_000)


def test_a_route_runs_the_same_twice():
    route = prepare(TURNS, PathSettings(allow_reversing=True))
    runs = []
    for _ in range(2):
        driver = Driver(REVERSING)
        driver.follow(dataclasses.replace(route))
        _, outputs, _ = drive(driver, [0.0, 0.1, 0.2], 700)
        runs.append(np.array([output.command for output in outputs]))
    np.testing.assert_array_equal(*runs)
