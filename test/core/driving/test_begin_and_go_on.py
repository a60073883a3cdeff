"""A robot begins where the job begins, and goes on where it stopped."""

from __future__ import annotations

import math

import numpy as np
import pytest
from field_routes import OPEN, case, random_route
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.geometry import tracking_error
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.schema import build
from sim_unicycle.settings import PlantSettings
from sim_unicycle.unicycle import Unicycle

PERIOD = 10_000_000  # [ns]


class Robot:
    """An ideal robot and its driver."""

    def __init__(self, route, pose, **values):
        self.told, self.warned = [], []
        self.driver = Driver(
            build(Settings, values),
            tell=self.warned.append,
            tell_start=self.told.append,
        )
        self.driver.follow(route)
        self.time = 0
        self.put(pose)

    def put(self, pose):
        """Put the robot down at a pose (3,)."""
        self.body = Unicycle(np.asarray(pose, float), PlantSettings())

    def drive(self, seconds):
        """Drive for a time, or to the goal; return the poses (N, 3)."""
        poses = []
        for _ in range(round(seconds * 1e9 / PERIOD)):
            self.time += PERIOD
            output = self.driver.command_for(self.body.pose, self.time)
            poses.append(self.body.pose)
            if self.driver.at_goal:
                break
            self.body.step(output.command, 1e-9 * PERIOD)
        return np.array(poses)

    @property
    def place(self):
        """Return s_p of the virtual target [m]."""
        return float(self.driver.follower.arc_length)


def distance_driven(poses):
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


def farthest_from(route, poses):
    """Return the largest distance of poses from a route's samples [m]."""
    samples = route.segments[0].path.samples
    gaps = np.hypot(samples.x - poses[::5, :1], samples.y - poses[::5, 1:2])
    return float(gaps.min(axis=1).max())


@pytest.mark.parametrize(
    ("name", "paths", "behind", "turn"),
    [
        ("loop_open.csv", OPEN, 0.02, 0.0),
        ("loop_gap_3cm.csv", PathSettings(), 0.02, 0.0),
        ("three_laps_noisy.csv", PathSettings(), 0.01, 0.0),
        ("lawnmower_lanes_0.5m.csv", PathSettings(), 0.0, math.radians(149.0)),
    ],
)
def test_all_of_a_path_is_driven(name, paths, behind, turn):
    route = case(name, paths)
    x, y, heading = route.segments[0].path.frame(0.0).pose
    start = [x - behind * math.cos(heading), y - behind * math.sin(heading), heading + turn]
    robot = Robot(route, start, desired_speed=0.8, learning=False)
    poses = robot.drive(60.0)
    assert robot.driver.at_goal
    assert distance_driven(poses) > route.length - 0.2
    assert robot.told == [f"begins at 0.0 of {route.length:.1f} m"]
    assert not robot.warned


def test_lanes_are_driven_in_their_order():
    """With 0.25 m to the next lane, whose direction is the robot's."""
    route = case("lawnmower_lanes_0.5m.csv")
    robot = Robot(route, [0.0, 0.0, math.radians(149.0)], desired_speed=0.8, learning=False)
    poses = robot.drive(60.0)
    middle = poses[np.abs(poses[:, 0] - 3.0) < 0.02]
    lanes = np.round(middle[:, 1] / 0.5).astype(int)
    assert list(dict.fromkeys(lanes.tolist())) == sorted(set(lanes.tolist()))
    assert len(set(lanes.tolist())) >= 3


@pytest.mark.parametrize("start", ["earliest", "beginning", "nearest"])
def test_a_stopped_robot_goes_on_where_it_stopped(start):
    route = case("loop_2m.csv", OPEN)
    first = route.segments[0].path.frame(0.0).pose
    robot = Robot(route, first, desired_speed=0.8, path_start=start, learning=False)
    before = robot.drive(8.0)
    robot.driver.stopped()
    assert robot.driver.restart()
    after = robot.drive(20.0)
    assert robot.told[-1] == "goes on at 6.4 of 12.6 m"
    assert robot.driver.at_goal
    driven = np.concatenate([before, after])
    assert farthest_from(route, driven) < 0.02
    assert distance_driven(driven) == pytest.approx(route.length, abs=0.1)


@settings(max_examples=15)
@given(
    number=st.integers(0, 23),
    seconds=st.floats(2.0, 10.0),
    coasted=st.floats(-0.3, 0.6),
    noise=st.floats(-0.02, 0.02),
)
def test_the_place_is_the_distance_driven_through_stops(number, seconds, coasted, noise):
    """The odometer of a robot on the path is independent of every search."""
    route = random_route(number)
    path = route.segments[0].path
    robot = Robot(route, path.frame(0.0).pose, learning=False)
    driven = distance_driven(robot.drive(seconds))
    assert robot.place == pytest.approx(driven, abs=0.15)
    robot.driver.stopped()
    robot.driver.restart()
    place = min(max(driven + coasted, 0.0), path.length - 1.0)
    robot.put(path.frame(place).pose + np.array([0.0, noise, 0.1]))
    robot.drive(0.01)
    assert robot.place == pytest.approx(place, abs=0.3)


def test_a_robot_that_was_carried_while_it_stood_is_looked_for():
    route = case("lawnmower_lanes_0.5m.csv")
    robot = Robot(route, [0.0, 0.0, 0.0], learning=False)
    robot.drive(2.0)
    robot.driver.stopped()  # as in a fault that ends by itself, and when deactivated
    robot.drive(0.5)
    assert len(robot.told) == 1  # it was where it stopped
    robot.driver.stopped()
    robot.put([3.0, 1.0, 0.0])  # in the third lane
    robot.drive(0.01)
    assert robot.told[-1].startswith("goes on at 1")
    np.testing.assert_allclose(
        tracking_error(robot.body.pose, route.segments[0].path.frame(robot.place).pose),
        0.0,
        atol=0.02,
    )


def test_a_part_that_is_left_out_is_warned_of():
    route = case("lawnmower_lanes_0.5m.csv")
    robot = Robot(route, [3.0, 0.5, math.pi], learning=False)
    robot.drive(0.01)
    assert robot.warned == [
        "begins at 7.7 of 22.0 m: the path before is left out, unless path_start is 'beginning'"
    ]
    chosen = {"path_start": "arc_length", "start_arc_length": 10.9}
    robot = Robot(route, [3.0, 0.5, math.pi], learning=False, **chosen)
    robot.drive(0.01)
    assert (robot.told, robot.warned) == (["begins at 10.9 of 22.0 m"], [])


def test_replanning_keeps_progress_and_an_empty_path_ends_the_job():
    points = case("three_laps_noisy.csv").segments[0].path.points(0.03)[:, :2]
    whole, rest = (Path.from_points(points[first:]) for first in (0, 60))
    robot = Robot(whole, [*points[0], 0.0], learning=False)
    robot.drive(10.0)
    place = robot.place
    assert 4.0 < place < 6.0  # in the second lap
    robot.driver.follow(rest)
    robot.drive(0.01)
    assert robot.place == pytest.approx(place - (whole.length - rest.length), abs=0.05)
    robot.driver.follow(whole)
    robot.drive(0.01)
    assert robot.place == pytest.approx(place, abs=0.05)
    robot.driver.follow(Path.from_points(points[int(place / 0.03) :]))  # without what is driven
    robot.drive(0.01)
    assert robot.place == pytest.approx(0.0, abs=0.1)
    assert [text.split(" at ")[0] for text in robot.told] == ["begins", *["goes on"] * 3]
    robot.driver.follow(None)
    robot.driver.follow(whole)
    robot.drive(0.01)
    assert robot.place < 3.0


def test_a_speed_that_the_limits_forbid_is_warned_of_once():
    told = []
    driver = Driver(build(Settings, {"desired_speed": 1.5}), tell=told.append)
    driver.take_over(driver.prepared(driver.settings.with_changes(debug_rate=10.0)))
    assert told == ["'desired_speed' is 1.5 m/s, but 'max_linear_vel' 1: the robot drives at 1 m/s"]
    driver.take_over(driver.prepared(driver.settings.with_changes(max_linear_vel=2.0)))
    driver.take_over(driver.prepared(driver.settings.with_changes(desired_speed=2.5)))
    assert [text.split(",")[0] for text in told[1:]] == ["'desired_speed' is 2.5 m/s"]
