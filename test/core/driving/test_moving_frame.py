"""A frame that moves beneath the robot, against motion in closed form."""

import math

import numpy as np
import pytest

from adp_path_follower.core.driving.moving_frame import MovingFrame

PERIOD = 100_000_000  # [ns] of the transforms


@pytest.mark.parametrize("speed", [0.5, -0.5])
def test_the_heading_becomes_that_of_the_motion_over_ground(speed):
    """Driven so that the drift to the left and the robot's own motion add up to one along x."""
    frame = MovingFrame()
    drift, heading = 0.05, -math.asin(0.05 / speed)
    for step in range(100):
        time = 0.1 * step
        robot = np.array([speed * math.cos(heading) * time, -drift * time, heading])
        frame.take(np.array([0.0, drift * time, 0.0]), step * PERIOD, robot)
        found = frame.located(robot, speed)
        assert found[1] == pytest.approx(0.0, abs=1e-12)
    assert found[2] == pytest.approx(0.0, abs=1e-3)
    assert frame.located(robot, 0.0)[2] == pytest.approx(heading)  # at rest it is the robot's own


def test_a_jump_is_taken_up_at_once_and_is_no_drift():
    frame, robot = MovingFrame(), np.array([2.0, 0.0, 0.0])
    frame.take(np.zeros(3), 0, robot)
    jumped = np.array([0.0, 0.6, 0.1])
    moved, turned = frame.correction(jumped, robot)
    aside = 0.6 + 2.0 * math.sin(0.1)
    assert moved == pytest.approx(math.hypot(2.0 * math.cos(0.1) - 2.0, aside))
    assert turned == pytest.approx(0.1)
    frame.take(jumped, PERIOD, robot)
    expected = [2.0 * math.cos(0.1), aside, 0.1]
    np.testing.assert_allclose(frame.located(robot, 0.5), expected, atol=1e-12)


def test_a_transform_that_never_changes_has_no_drift():
    frame, robot = MovingFrame(), np.array([1.0, 1.0, 0.5])
    for _ in range(2):
        frame.take(np.array([3.0, 0.0, 0.5 * math.pi]), None, robot)
    np.testing.assert_allclose(
        frame.located(robot, 0.5), [2.0, 1.0, 0.5 + 0.5 * math.pi], atol=1e-12
    )
