"""The plant on MuJoCo, on which robots are learned, rolls as wheels do."""

import math

import numpy as np
import pytest
from robots import Robot

mujoco_plant = pytest.importorskip("mujoco_plant", reason="mujoco, of the extra robots, is missing")
ROBOT = Robot(radius_error=-0.02, track_error=0.03, wheel_difference=0.01, lag=0.1, mass=12.0)


def test_it_rolls_without_creep_and_answers_by_its_lag():
    plant = mujoco_plant.MujocoPlant(ROBOT, np.zeros(3))
    still = mujoco_plant.driven(plant, (0.0, 0.0), 1.0)
    rows = mujoco_plant.driven(plant, (0.5, 0.0), 3.0)
    assert np.abs(still[-1, :2]).max() < 1e-5
    gain, _, bias = ROBOT.gains
    assert rows[-1, 3:5] == pytest.approx([0.5 * gain, 0.5 * bias], abs=1e-4)
    left, right = (rows[-1, 5:] - still[-1, 5:]) * 0.049 * [0.995, 1.005]
    assert rows[-1, 2] == pytest.approx((right - left) / 0.309, rel=2e-3)
    assert math.hypot(*rows[-1, :2]) == pytest.approx(0.5 * (left + right), rel=2e-3)
    answer = np.searchsorted(rows[:, 3], (1.0 - math.exp(-1.0)) * 0.5 * gain) * 0.002
    assert answer == pytest.approx(0.11, abs=0.005)


def test_it_drives_the_circle_of_its_encoders():
    plant = mujoco_plant.MujocoPlant(ROBOT, np.zeros(3))
    rows = mujoco_plant.driven(plant, (0.5, 0.5), 15.0)[1000:]
    left, right = (rows[-1, 5:] - rows[0, 5:]) * 0.05
    v, w = 0.5 * (left + right), (right - left) / 0.3
    gain, turn_gain, bias = ROBOT.gains
    turned = np.unwrap(rows[:, 2])
    assert turned[-1] - turned[0] == pytest.approx(turn_gain * w + bias * v, rel=2e-3)
    size = np.ptp(rows[:, :2], axis=0)
    assert size / 2 == pytest.approx(gain * v / (turn_gain * w + bias * v), rel=3e-3)
