"""The virtual target: copies of it, and time that is not to pass."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from steady import steady_reference, steady_target

from adp_path_follower.core.control.cost import RunningCost
from adp_path_follower.core.geometry import pose_in_frame
from adp_path_follower.core.path.library import circle
from adp_path_follower.core.settings.groups import CostSettings, TargetSettings

PATH = circle(0.5)
SLOW = TargetSettings(desired_speed=0.5)
FAST = TargetSettings(desired_speed=2.0)
errors = st.tuples(*[st.floats(-0.5, 0.5)] * 3).map(np.array)
periods = st.floats(1e-3, 0.1)


def observed(place, error):
    """Return a target that has seen a robot at a place, and the robot's pose."""
    target = steady_target(PATH, SLOW, place)
    pose = pose_in_frame(error, PATH.frame(place).pose)
    target.move(pose, 0.0)
    return target, pose


@settings(max_examples=50)
@given(place=st.floats(0.0, 20.0), error=errors, dt=periods)
def test_the_first_move_only_looks(place, error, dt):
    target = steady_target(PATH, SLOW, place)
    frame, found = target.move(pose_in_frame(error, PATH.frame(place).pose), dt)
    assert target.arc_length == place
    np.testing.assert_allclose(found, error, atol=1e-9)
    assert frame.pose.tolist() == PATH.frame(place).pose.tolist()


@settings(max_examples=50)
@given(place=st.floats(0.0, 20.0), error=errors, dt=periods)
def test_after_a_hold_one_move_takes_no_time_and_the_next_one_does(place, error, dt):
    target, pose = observed(place, error)
    target.hold()
    target.move(pose, dt)
    assert target.arc_length == place
    target.move(pose, dt)
    speed = 0.5 * math.cos(error[2]) + 0.1 * error[0]
    assert target.arc_length - place == pytest.approx(speed * dt, rel=0.1)


@settings(max_examples=50)
@given(place=st.floats(0.0, 20.0), error=errors, dt=periods)
def test_a_copy_goes_on_from_the_same_place_by_its_own_settings(place, error, dt):
    target, pose = observed(place, error)
    same, faster = (target.copy(item, steady_reference(PATH, item)) for item in (SLOW, FAST))
    faster.move(pose, dt)
    assert target.arc_length == same.arc_length == place  # copies are independent
    target.move(pose, dt)
    same.move(pose, dt)
    assert same.arc_length == target.arc_length
    ratio = (2.0 * math.cos(error[2]) + 0.1 * error[0]) / (
        0.5 * math.cos(error[2]) + 0.1 * error[0]
    )
    moved = (faster.arc_length - place) / (target.arc_length - place)
    assert moved == pytest.approx(ratio, rel=0.1)


def test_a_copy_of_a_held_target_is_held():
    target, pose = observed(3.0, np.array([0.1, 0.2, 0.3]))
    target.hold()
    copied = target.copy(FAST, steady_reference(PATH, FAST))
    copied.move(pose, 0.1)
    assert copied.arc_length == 3.0


def test_one_start_serves_a_batch():
    target = steady_target(PATH, SLOW, 3.0)
    pose = np.broadcast_to(PATH.frame(3.0).pose, (2, 4, 3))
    target.move(pose, 0.0)
    target.move(pose, 0.02)
    assert target.arc_length.shape == (2, 4)
    np.testing.assert_allclose(target.arc_length, 3.01, rtol=1e-3)


@settings(max_examples=50)
@given(error=errors, v=st.floats(-2.0, 2.0), w=st.floats(-2.0, 2.0))
def test_the_running_cost_is_the_sum_of_its_quadratic_forms(error, v, w):
    q, r = (1.0, 0.2, 0.0, 0.2, 2.0, 0.1, 0.0, 0.1, 1.0), (1.0, 0.3, 0.3, 2.0)
    cost = RunningCost(CostSettings(q, r))
    s, y, theta = error
    expected = s * s + 2 * y * y + theta * theta + 0.4 * s * y + 0.2 * y * theta
    expected += v * v + 2 * w * w + 0.6 * v * w
    assert cost(error, np.array([v, w])) == pytest.approx(expected, abs=1e-12)
    batch = cost(np.tile(error, (3, 2, 1)), np.tile([v, w], (3, 2, 1)))
    np.testing.assert_allclose(batch, np.full((3, 2), expected), atol=1e-12)
