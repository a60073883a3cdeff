"""The robot's model moves as its equations say."""

import math

import numpy as np
import pytest
from plants import STEP, Firmware
from robots import Robot
from scipy.integrate import solve_ivp

from adp_path_follower.core.robot.compensation import (
    compensated,
    ideal_state,
    lag_left,
    let_through,
)
from adp_path_follower.core.robot.history import CommandHistory
from adp_path_follower.core.robot.model import IDEAL, RobotModel, RobotState, advanced

MODEL = RobotModel(0.1, 0.2, 0.15, 2.0, 0.97, 0.94, 0.03)
START = RobotState(1.0, -2.0, 0.4, 0.1, -0.2)


def integrated(model, start, commands):
    """Return the state after commands, by fine integration of the model's equations."""
    state = np.array([start.x, start.y, start.theta, start.v, start.w])
    for wanted_v, wanted_w, dt in commands:

        def rate(_, s, wanted_v=wanted_v, wanted_w=wanted_w):
            forwards, turn = model.linear_gain * s[3], model.angular_gain * s[4]
            turn += model.bias * s[3]
            return [
                *(forwards * math.cos(s[2]), forwards * math.sin(s[2]), turn),
                (wanted_v - s[3]) / model.linear_lag,
                (wanted_w - s[4]) / model.angular_lag,
            ]

        state = solve_ivp(rate, (0.0, dt), state, rtol=1e-11, atol=1e-12).y[:, -1]
    return state


def test_propagation_is_that_of_fine_integration():
    rng = np.random.default_rng(0)
    commands = [(*rng.uniform(-1.0, 1.0, 2), 0.01) for _ in range(60)]
    found = advanced(MODEL, START, commands)
    exact = integrated(MODEL, START, commands)
    found = [found.x, found.y, found.theta, found.v, found.w]
    np.testing.assert_allclose(found[2:], exact[2:], atol=1e-9)
    np.testing.assert_allclose(found[:2], exact[:2], atol=2e-6)  # arcs of 10 ms


def test_the_ideal_robot_drives_arcs():
    found = advanced(IDEAL, RobotState(0.0, 0.0, 0.0), [(0.5, 0.25, 4.0)])
    assert (found.x, found.y) == pytest.approx((2.0 * math.sin(1.0), 2.0 * (1.0 - math.cos(1.0))))
    assert (found.theta, found.v, found.w) == (1.0, 0.5, 0.25)


def test_the_history_gives_what_was_in_force():
    history = CommandHistory()
    for time, v in ((1.0, 0.5), (1.1, 0.7), (1.2, 0.2)):
        history.send(time, (v, 0.1))
    held = history.held(0.9, 1.25)
    np.testing.assert_allclose(
        held, [(0, 0, 0.1), (0.5, 0.1, 0.1), (0.7, 0.1, 0.1), (0.2, 0.1, 0.05)], atol=1e-12
    )
    assert history.held(1.25, 1.2) == []
    np.testing.assert_allclose(history.ahead(1.3, 0.2), [(0.2, 0.1, 0.2)])


def test_a_ramp_is_let_through_at_its_rate():
    history = CommandHistory()
    history.ramps = (2.0, 5.0)
    history.send(0.0, (1.0, -1.0))
    held = history.held(0.0, 1.0)
    assert sum(v * dt for v, _, dt in held) == pytest.approx(0.75)  # a ramp of 0.5 s
    assert sum(w * dt for _, w, dt in held) == pytest.approx(-0.9)
    history.send(0.25, (0.0, 0.0))
    assert sum(v * dt for v, _, dt in history.held(0.0, 1.0)) == pytest.approx(0.125)


@pytest.mark.parametrize("lag", [0.03, 0.05, 0.2])
def test_compensated_the_robot_is_an_ideal_unicycle(lag):
    period, state = 0.01, RobotState(1.0, -2.0, 0.4)
    ideal = RobotState(1.0, -2.0, 0.4)
    for step in range(300):
        wanted = np.array([0.4 + 0.1 * math.sin(0.01 * step), 0.8 * math.sin(0.02 * step)])
        v, w = compensated(MODEL, state, wanted, lag, period)
        x, y, theta, wheels_v, wheels_w = integrated(MODEL, state, [(v, w, period)])
        state = RobotState(x, y, theta, wheels_v, wheels_w)
        ideal = advanced(IDEAL, ideal, [(*wanted, period)])
    found = ideal_state(MODEL, state, lag)
    assert found.theta == pytest.approx(ideal.theta, abs=0.02 * lag)
    away = math.hypot(found.x - ideal.x, found.y - ideal.y)
    assert away < 0.005 * lag + 0.5 * 0.5 * lag**2  # v w lag^2 / 2 in a bend
    assert MODEL.motion(state.v, state.w) == pytest.approx(tuple(wanted), abs=2.0 * lag)


def test_without_a_lag_the_command_is_the_wheels_velocity():
    wanted = np.array([0.5, -0.3])
    found = compensated(IDEAL, RobotState(0.0, 0.0, 0.0), wanted, lag_left(IDEAL), 0.01)
    assert found.tolist() == wanted.tolist()


def test_wheels_with_a_ramp_change_speed_and_turn_together():
    robot, period = Robot(track=0.4, ramp=1.5), 0.01
    ramp, angular_ramp = robot.ramps
    model, firmware = RobotModel(ramp=ramp, angular_ramp=angular_ramp), Firmware(robot)
    wanted, reached, together = np.array([0.6, -1.2]), np.zeros(2), []
    for _ in range(70):
        reached = let_through(model, wanted, reached, period)
        for _ in range(round(period / STEP)):
            left, right = firmware.step(reached)
        together.append([0.5 * (left + right), (right - left) / robot.track])
    shares = np.array(together) / wanted
    np.testing.assert_allclose(shares[:, 0], shares[:, 1], atol=1e-9)
    soonest = (0.6 + 0.2 * 1.2) / 1.5  # of the right wheel, which changes most
    assert np.searchsorted(shares[:, 0], 0.999) * period == pytest.approx(soonest, abs=0.01)
