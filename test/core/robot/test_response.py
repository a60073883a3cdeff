"""The bank finds delay, lags and ramps of a robot that is known."""

import math

import numpy as np
import pytest

from adp_path_follower.core.robot.history import CommandHistory
from adp_path_follower.core.robot.model import IDEAL, RobotModel, RobotState, advanced
from adp_path_follower.core.robot.response import ResponseBank


@pytest.mark.parametrize(
    ("ramp", "angular_ramp"), [(math.inf, math.inf), (1.2, 4.0), (3.0, math.inf), (math.inf, 6.0)]
)
def test_delay_lags_and_ramps_are_found_from_noisy_encoders(ramp, angular_ramp):
    robot = RobotModel(0.08, 0.12, 0.1, ramp, angular_ramp=angular_ramp)
    bank, history, rng = ResponseBank(IDEAL), CommandHistory(), np.random.default_rng(4)
    history.ramps = robot.ramps
    state = RobotState(0.0, 0.0, 0.0)
    for step in range(1200):
        time = 0.01 * step
        # Starts, stops and turns: corners, as of a route, with two slow swings between them.
        v = 0.6 if time % 4.0 < 3.0 else 0.0
        w = (1.2 if time % 2.0 < 0.7 else -0.4) * (v > 0.0)
        history.send(time, (v, w))
        bank.advance(time, (v, w))
        if step % 3 == 0:
            measured = np.array([state.v, state.w]) + rng.normal(0.0, [0.01, 0.02])
            bank.observe(time, *measured.tolist())
        begun = time - robot.delay
        state = advanced(robot, state, history.held(begun, begun + 0.01))
    found = bank.response()
    assert found.delay == pytest.approx(robot.delay, abs=0.02)
    assert found.linear_lag == pytest.approx(robot.linear_lag, abs=0.03)
    assert found.angular_lag == pytest.approx(robot.angular_lag, abs=0.03)
    assert 1.0 / found.ramp == pytest.approx(1.0 / ramp, abs=0.1)
    assert 1.0 / found.angular_ramp == pytest.approx(1.0 / angular_ramp, abs=0.05)
