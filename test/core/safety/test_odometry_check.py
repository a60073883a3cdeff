"""Which odometry cannot follow the message before, against motions that a robot can make."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.geometry import advance_pose, wrap_angle
from adp_path_follower.core.safety.odometry_check import (
    Measurement,
    MissingTwist,
    OdometryCheck,
)
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

FAST = {"odom_timeout": 0.5, "odom_jump_tolerance": 0.2, "max_linear_vel": 10.0}
TUNING = build(Settings, {**FAST, "max_angular_vel": 5.0})
SECOND = 1_000_000_000
STILL = np.zeros(2)


def told(check, stamp, pose, twist=STILL, frame="base_link", now=0.0, tuning=TUNING):
    """Return the problem of a message at a time [s], empty if there is none."""
    problem = found(check, stamp, pose, twist, frame, now, tuning)
    return "" if problem is None else problem.text


def found(check, stamp, pose, twist=STILL, frame="base_link", now=0.0, tuning=TUNING):
    """Return what the check finds."""
    message = measured_at(round(stamp * SECOND), np.array(pose, float), np.array(twist), frame)
    return check.problem(round(now * SECOND), message, tuning)


def measured_at(stamp, pose, twist=STILL, frame="base_link"):
    """Return the measurement of a message."""
    return Measurement(stamp, pose, twist, "odom", frame)


@settings(max_examples=60)
@given(
    seed=st.integers(0, 1000),
    period=st.floats(0.001, 0.4),
    fastest=st.floats(0.0, 5.0),
    noise=st.floats(0.0, 0.02),
)
def test_what_a_robot_can_do_is_no_fault(seed, period, fastest, noise):
    random, check, pose = np.random.default_rng(seed), OdometryCheck(), np.zeros(3)
    for step in range(30):
        twist = random.uniform(-fastest, fastest, 2)
        measured = pose + random.uniform(-noise, noise, 3)
        measured[2] = wrap_angle(measured[2])
        assert told(check, 10.0 + step * period, measured, twist) == ""
        pose = advance_pose(pose, twist[0], twist[1], period)


@pytest.mark.parametrize(
    ("second", "text"),
    [
        ({"stamp": 9.99, "pose": (0, 0, 0)}, "stamps went back by 0.010 s"),
        ({"stamp": 10.02, "pose": (0.3, 0, 0)}, "jumped by 0.30 m in 0.020 s"),
        ({"stamp": 10.02, "pose": (0, 0, 2.0)}, "turned by 2.00 rad in 0.020 s"),
        ({"stamp": 10.02, "pose": (0, 0, 0), "frame": "base"}, "of 'base' now"),
        ({"stamp": 10.02, "pose": (0, 0, 0), "now": 11.0}, "0.98 s old by its stamp"),
        ({"stamp": 10.02, "pose": (0.3, 0, 0), "twist": (6.0, 0.0)}, ""),
        ({"stamp": 10.0, "pose": (0, 0, 0)}, ""),
        ({"stamp": 11.0, "pose": (10, 0, 3)}, ""),  # after a gap it may have driven on
        ({"stamp": 11.0, "pose": (50, 0, 3)}, "came 1.0 s later, and is 50.00 m from where it was"),
        ({"stamp": 3.0, "pose": (1, 0, 0)}, "went back in time, and is 1.00 m from where it was"),
        ({"stamp": 10.02, "pose": (0, 0, 0), "now": 9.0}, "1.02 s ahead by its stamp"),
        (
            {"stamp": 10.02, "pose": (0, 0, 0), "twist": (50.0, 0)},
            "50 m/s, but max_linear_vel is 10",
        ),
        ({"stamp": 10.02, "pose": (0, 0, 0), "twist": (0, 19.0)}, "19 rad/s, but max_angular_vel"),
        ({"stamp": 10.02, "pose": (0, 0, 0), "now": 10.03}, ""),
    ],
)
def test_what_cannot_follow_is_named(second, text):
    check = OdometryCheck()
    assert told(check, 10.0, (0, 0, 0)) == ""
    problem = told(check, **second)
    assert text in problem
    assert bool(problem) == bool(text)


def test_a_jump_clears_itself_and_another_robot_does_not():
    check = OdometryCheck()
    told(check, 10.0, (0, 0, 0))
    assert told(check, 10.1, (5, 0, 0))
    assert told(check, 10.2, (5, 0, 0)) == ""
    assert told(check, 10.3, (5, 0, 0), frame="other")
    assert told(check, 10.4, (5, 0, 0), frame="other")
    assert told(check, 10.5, (5, 0, 0)) == ""


def test_any_jump_can_be_allowed():
    check = OdometryCheck()
    allowing = build(Settings, {"odom_jump_tolerance": math.inf})
    told(check, 10.0, (0, 0, 0), tuning=allowing)
    assert told(check, 10.1, (500, 0, 3), tuning=allowing) == ""
    assert told(check, 20.0, (0, 0, 0), tuning=allowing) == ""


def test_who_is_elsewhere_after_a_silence_waits_for_somebody_to_look():
    for stamp in (11.0, 3.0):
        check = OdometryCheck()
        told(check, 10.0, (0, 0, 0))
        assert found(check, stamp, (50, 0, 0)).lasts
        assert found(check, stamp + 0.1, (50, 0, 0)) is None
    check = OdometryCheck()
    told(check, 10.0, (0, 0, 0))
    assert not found(check, 10.1, (50, 0, 0)).lasts


@pytest.mark.parametrize("period", [0.005, 0.02, 0.1])
def test_small_steps_that_no_velocity_explains_add_up(period):
    check = OdometryCheck()
    problems = [told(check, 10.0 + n * period, (2.0 * n * period, 0, 0)) for n in range(100)]
    first = next(index for index, problem in enumerate(problems) if problem)
    # 2 m/s at a standstill: as soon as it comes to the tolerance of 0.2 m, and some forgetting.
    assert 0.1 < first * period < 0.201
    assert "that its velocity does not explain" in problems[first]


def test_a_robot_may_be_as_fast_as_it_once_was_allowed():
    check = OdometryCheck()
    told(check, 10.0, (0, 0, 0), (20.0, 0.0))
    slower = build(Settings, {**FAST, "max_linear_vel": 0.5})
    assert told(check, 10.02, (0.4, 0, 0), (20.0, 0.0), tuning=slower) == ""


@settings(max_examples=15)
@given(
    period=st.sampled_from([0.01, 1.0 / 30.0, 0.1]),
    v=st.floats(0.2, 1.8),
    w=st.floats(-1.0, 1.0),
    noise=st.floats(0.0, 0.001),
)
def test_a_velocity_that_is_missing_is_taken_from_the_poses(period, v, w, noise):
    missing, check, random = MissingTwist(), OdometryCheck(), np.random.default_rng(0)
    pose, found = np.zeros(3), []
    for step in range(round(3.0 / period)):
        stamp = round((10.0 + step * period) * SECOND)
        measured = pose + random.uniform(-noise, noise, 3)
        measured[2] = wrap_angle(measured[2])
        found.append(missing.twist(measured_at(stamp, measured), TUNING))
        assert told(check, 1e-9 * stamp, measured, found[-1]) == ""
        pose = advance_pose(pose, v, w, period)
    assert missing.missing
    later = np.array(found[len(found) // 2 :])
    np.testing.assert_allclose(later.mean(axis=0), [v, w], atol=0.02)
    sound = np.array([0.3, 0.1])
    assert missing.twist(measured_at(10**12, pose, sound), TUNING) is sound
    assert not missing.missing  # for good: a source that has velocities means its zeros
    later_on = measured_at(10**12 + SECOND // 10, pose + 0.2)
    assert missing.twist(later_on, TUNING) is STILL


def test_a_robot_at_rest_and_one_that_jumps_have_no_other_velocity_than_theirs():
    for step_of in (lambda step: 0.0, lambda step: 3.0 * (step > 5)):
        missing = MissingTwist()
        for step in range(50):
            pose = np.array([step_of(step), 0.0, 0.0])
            message = measured_at(SECOND + step * SECOND // 100, pose)
            assert missing.twist(message, TUNING) is STILL
