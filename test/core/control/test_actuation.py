"""Commands under way: prediction over a delay, stops, and commands that outlive a follower."""

from __future__ import annotations

import itertools
import math
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.control.actuation import Actuation
from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import advance_pose, pose_in_frame
from adp_path_follower.core.path.library import circle, lissajous, named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build, update
from sim_unicycle.settings import PlantSettings
from sim_unicycle.unicycle import Unicycle

DEFAULT = build(Settings, {})
LIMITS = {"max_linear_accel": 0.5, "max_linear_decel": 0.8, "max_angular_accel": 2.0}
MILLISECOND = 1_000_000
EIGHT = lissajous()


@settings(max_examples=60)
@given(
    sent=st.lists(
        st.tuples(st.floats(0.001, 0.2), st.floats(-1.0, 1.0), st.floats(-3.0, 3.0)),
        min_size=1,
        max_size=12,
    ),
    delay=st.floats(0.0, 1.0),
)
def test_the_prediction_is_the_motion_of_the_commands_under_way(sent, delay):
    actuation = Actuation()
    pose = np.array([0.3, -0.2, 1.0])
    now, commands = 0.0, []
    for period, v, w in sent:
        actuation.advance(period)
        assert actuation.predicted(pose, 0.0) is pose
        now += period
        actuation.send(np.array([v, w]), DEFAULT)
        commands.append((now, v, w))
    actuation.advance(0.05)
    found = actuation.predicted(pose, delay)
    now += 0.05
    # A command at t moves the robot from t + delay on, until the next command does.
    changes = sorted({now - delay, now, *(time for time, _, _ in commands if time > now - delay)})
    expected = pose
    for begin, end in itertools.pairwise(changes):
        held = [(v, w) for time, v, w in commands if time <= begin]
        expected = advance_pose(expected, *(held[-1] if held else (0.0, 0.0)), end - begin)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert actuation.predicted(pose, delay).tolist() == found.tolist()  # asking moves no clock


def test_a_batch_is_predicted_robot_by_robot():
    random = np.random.default_rng(1)
    together, singles = Actuation(), [Actuation() for _ in range(4)]
    pose = random.normal(size=(4, 3))
    for _ in range(6):
        command = random.normal(size=(4, 2))
        for index, single in enumerate((together, *singles)):
            single.advance(0.1)
            single.send(command if not index else command[index - 1], DEFAULT)
    together.advance(0.1)
    found = together.predicted(pose, 0.25)
    for index, single in enumerate(singles):
        single.advance(0.1)
        alone = single.predicted(pose[index], 0.25)
        np.testing.assert_allclose(found[index], alone, rtol=1e-14)


class DelayLine:
    """An ideal robot whose commands take effect a while later."""

    def __init__(self, pose, delay):
        self.robot = Unicycle(pose, PlantSettings())
        self._waiting = deque([np.zeros(2)] * round(delay / 0.01))

    def step(self, command):
        """Move for one period."""
        self._waiting.append(command)
        self.robot.step(self._waiting.popleft(), 0.01)


def drive(delay, known, path=EIGHT, seconds=20.0, **values):
    """Return the error of the true robot to the target's path over the last half, (N, 3)."""
    tuning = build(Settings, {"actuation_delay": known, "learning": False, **values})
    follower = PathFollower(tuning, path, 12.0)
    start = pose_in_frame(np.array([-0.2, 0.15, -0.3]), path.frame(12.0).pose)
    plant, errors = DelayLine(start, delay), []
    for _ in range(round(seconds * 100)):
        pose = plant.robot.pose
        plant.step(follower.step(pose, 0.01).command)
        nearest = path.frame(np.linspace(-1.0, 1.0, 401) + follower.arc_length).pose
        place = np.argmin(np.hypot(*(nearest[:, :2] - pose[:2]).T))
        errors.append(np.hypot(*(nearest[place, :2] - pose[:2])))
    return np.array(errors[len(errors) // 2 :])


@pytest.mark.parametrize("delay", [0.05, 0.2])
def test_a_known_delay_hardly_matters(delay):
    """With a delay that is known the robot is as near to the path as without one."""
    free, known, unknown = drive(0.0, 0.0), drive(delay, delay), drive(delay, 0.0)
    assert known.max() <= free.max() + 2e-4
    assert unknown.max() > 3.0 * known.max()


# --- what outlives a follower -------------------------------------------------------------------


def driven(driver, pose, time, steps, commands):
    """Drive an ideal robot on; return pose and time, and note the commands."""
    for _ in range(steps):
        time += 10 * MILLISECOND
        command = driver.step(pose, time).command
        commands.append(command)
        pose = advance_pose(pose, *command, 0.01)
    return pose, time


def assert_within_acceleration_limits(commands):
    change = np.diff(np.array([np.zeros(2), *commands]), axis=0) / 0.01
    faster = np.abs(commands)[:, 0] > np.abs([np.zeros(2), *commands[:-1]])[:, 0]
    assert np.abs(change[faster, 0]).max(initial=0.0) <= 0.5 + 1e-9
    assert np.abs(change[~faster, 0]).max(initial=0.0) <= 0.8 + 1e-9
    assert np.abs(change[:, 1]).max() <= 2.0 + 1e-9


def test_neither_a_new_path_nor_new_parameters_make_the_command_jump():
    tuning = build(Settings, LIMITS)
    driver, commands = Driver(tuning), []
    driver.follow(named_path("line"))
    pose, time = driven(driver, np.array([1.0, 0.2, 0.3]), 0, 150, commands)
    assert commands[-1][0] > 0.4
    driver.follow(circle(1.0))
    pose, time = driven(driver, pose, time, 50, commands)
    for change in ({"speed_limit": 0.1}, {"desired_speed": 0.9}, {"max_angular_vel": 0.2}):
        driver.take_over(driver.prepared(update(driver.settings, change)))
        pose, time = driven(driver, pose, time, 50, commands)
    assert_within_acceleration_limits(commands)


def test_after_a_stop_it_starts_from_rest_and_without_one_it_goes_on():
    driver, commands = Driver(build(Settings, LIMITS)), []
    assert not driver.stopped()  # nothing was commanded yet
    driver.follow(named_path("line"))
    pose, time = driven(driver, np.array([1.0, 0.0, 0.0]), 0, 100, commands)
    assert driver.stopped()
    assert not driver.stopped()
    assert driver.counts.stops == 1
    again = []
    driven(driver, pose, time, 30, again)
    assert_within_acceleration_limits(again)
    # After a gap nobody knows what the robot was told, so the node has told it to stop.
    late = []
    driven(driver, pose, time + 60_000 * MILLISECOND, 30, late)
    assert_within_acceleration_limits(late)


@settings(max_examples=40)
@given(
    steps=st.lists(
        st.tuples(
            st.sampled_from([0, 1, 5, 10, 10, 10, 40, 300, 700, -20]),  # [ms]
            st.floats(-3.0, 3.0),
            st.floats(-3.0, 3.0),
            st.floats(-10.0, 10.0),
        ),
        min_size=1,
        max_size=12,
    ),
    delay=st.sampled_from([0.0, 0.1]),
    path=st.sampled_from([EIGHT, circle(2.0), named_path("line")]),
)
def test_any_poses_at_any_times_give_finite_commands_within_all_limits(steps, delay, path):
    tuning = build(Settings, {**LIMITS, "actuation_delay": delay})
    driver = Driver(tuning)
    driver.follow(path)
    time, previous, before = 0, np.zeros(2), None
    for pause, x, y, theta in steps:
        time += pause * MILLISECOND
        command = driver.step(np.array([x, y, theta]), time).command
        elapsed = math.inf if before is None else (time - before) * 1e-9
        if not 0.0 < elapsed <= tuning.controller.odom_timeout:
            previous, elapsed = np.zeros(2), 0.01  # the node has stopped the robot meanwhile
        assert np.isfinite(command).all()
        assert -1e-12 <= command[0] <= 1.0 + 1e-12
        assert abs(command[1]) <= 1.5 + 1e-12
        elapsed = min(elapsed, 0.1)  # a pause is not made up for
        limit = 0.5 if command[0] > previous[0] else 0.8
        assert abs(command[0] - previous[0]) <= limit * elapsed + 1e-9
        assert abs(command[1] - previous[1]) <= 2.0 * elapsed + 1e-9
        previous, before = command, time
