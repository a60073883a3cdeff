"""The simulated robot against closed forms of motion, lag, delay and noise."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.integrate import solve_ivp

from sim_unicycle.settings import PlantSettings
from sim_unicycle.unicycle import Unicycle

twists = st.tuples(st.floats(-2.0, 2.0), st.floats(-3.0, 3.0)).map(np.array)
poses = st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(-3.0, 3.0)).map(np.array)


@settings(max_examples=50)
@given(
    pose=poses,
    commands=st.lists(st.tuples(twists, st.floats(0.001, 0.5)), min_size=1, max_size=5),
)
def test_an_ideal_robot_moves_exactly_as_commanded(pose, commands):
    robot = Unicycle(pose, PlantSettings())
    expected = pose
    for command, dt in commands:
        robot.step(command, dt)
        v, w = command
        expected = solve_ivp(
            lambda _, p, v=v, w=w: [v * math.cos(p[2]), v * math.sin(p[2]), w],
            (0.0, dt),
            expected,
            method="DOP853",
            rtol=1e-11,
            atol=1e-12,
        ).y[:, -1]
        np.testing.assert_array_equal(robot.twist, command)
    np.testing.assert_allclose(robot.pose, expected, atol=1e-8)


def test_a_full_circle_ends_where_it_began():
    robot = Unicycle(np.array([1.0, 2.0, 0.5]), PlantSettings())
    for _ in range(7):
        robot.step(np.array([0.8, 0.4]), 2.0 * math.pi / 0.4 / 7.0)
    np.testing.assert_allclose(robot.pose, [1.0, 2.0, 0.5 + 2.0 * math.pi], atol=1e-12)


@settings(max_examples=60)
@given(
    command=st.tuples(st.floats(-10.0, 10.0), st.floats(-10.0, 10.0)).map(np.array),
    lowest=st.floats(-2.0, 0.0),
    highest=st.floats(0.0, 2.0),
    turn=st.floats(0.0, 3.0),
    lag=st.sampled_from([0.0, 0.2]),
)
def test_the_robot_keeps_its_limits(command, lowest, highest, turn, lag):
    plant = PlantSettings(
        min_linear_vel=lowest, max_linear_vel=highest, max_angular_vel=turn, velocity_lag=lag
    )
    robot = Unicycle(np.zeros(3), plant)
    for _ in range(40):
        robot.step(command, 0.1)
        assert lowest - 1e-12 <= robot.twist[0] <= highest + 1e-12
        assert abs(robot.twist[1]) <= turn + 1e-12
    clipped = [min(max(command[0], lowest), highest), min(max(command[1], -turn), turn)]
    np.testing.assert_allclose(robot.twist, clipped, atol=1e-6)


@settings(max_examples=60)
@given(
    speed=st.floats(-2.0, 2.0),
    turn=st.floats(-2.0, 2.0),
    lag=st.floats(0.01, 2.0),
    steps=st.lists(st.floats(0.001, 0.5), min_size=1, max_size=8),
)
def test_lag_is_the_first_order_response(speed, turn, lag, steps):
    def response(final, time):
        """Return the distance after a step of the velocity from 0 through a first-order lag."""
        return final * (time + lag * math.expm1(-time / lag))

    straight = Unicycle(np.zeros(3), PlantSettings(velocity_lag=lag))
    spinning = Unicycle(np.zeros(3), PlantSettings(velocity_lag=lag))
    time = 0.0
    for dt in steps:
        straight.step(np.array([speed, 0.0]), dt)
        spinning.step(np.array([0.0, turn]), dt)
        mean = (response(speed, time + dt) - response(speed, time)) / dt
        assert straight.twist[0] == pytest.approx(mean, rel=1e-6, abs=1e-9)
        time += dt
    np.testing.assert_allclose(straight.pose, [response(speed, time), 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(spinning.pose, [0.0, 0.0, response(turn, time)], atol=1e-9)


def test_lag_in_a_turn_converges_to_the_lagging_robot():
    lag, duration = 0.4, 2.0
    first, then = np.array([1.0, 0.0]), np.array([0.2, 1.5])

    def rate(time, pose):
        reached = first * (1.0 - math.exp(-duration / lag))
        v, w = then + math.exp(-time / lag) * (reached - then)
        return [v * math.cos(pose[2]), v * math.sin(pose[2]), w]

    run_up = duration - lag * (1.0 - math.exp(-duration / lag))
    start = [run_up, 0.0, 0.0]
    exact = solve_ivp(rate, (0.0, duration), start, rtol=1e-10, atol=1e-12).y[:, -1]
    misses = []
    for count in (20, 40, 80):
        robot = Unicycle(np.zeros(3), PlantSettings(velocity_lag=lag))
        for command in (first, then):
            for _ in range(count):
                robot.step(command, duration / count)
        misses.append(np.linalg.norm(robot.pose - exact))
    assert misses[-1] < 1e-3
    assert misses[0] / misses[1] > 3.0
    assert misses[1] / misses[2] > 3.0


@settings(max_examples=40)
@given(
    commands=npst.arrays(float, (12, 2), elements=st.floats(-2.0, 2.0)),
    periods=st.integers(1, 6),
    lag=st.sampled_from([0.0, 0.15]),
)
def test_delay_shifts_the_response(commands, periods, lag):
    dt = 0.02
    late = Unicycle(np.zeros(3), PlantSettings(velocity_lag=lag, command_delay=periods * dt))
    prompt = Unicycle(np.zeros(3), PlantSettings(velocity_lag=lag))
    prompt_twists, late_twists = [], []
    for command in commands:
        late.step(command, dt)
        prompt.step(command, dt)
        late_twists.append(late.twist)
        prompt_twists.append(prompt.twist)
    np.testing.assert_array_equal(late_twists[:periods], np.zeros((periods, 2)))
    np.testing.assert_allclose(late_twists[periods:], prompt_twists[:-periods], atol=1e-12)


def test_a_longer_delay_than_the_run_keeps_the_robot_still():
    robot = Unicycle(np.array([1.0, 2.0, 3.0]), PlantSettings(command_delay=1.0))
    for _ in range(9):
        robot.step(np.array([1.0, 1.0]), 0.1)
    assert robot.pose.tolist() == [1.0, 2.0, 3.0]


def test_noise_has_its_standard_deviation_and_no_bias():
    plant = PlantSettings(position_noise=0.3, heading_noise=0.05, seed=5)
    robot = Unicycle(np.tile([1.0, -2.0, 0.3], (20_000, 1)), plant)
    measured = robot.measured_pose() - robot.pose
    # Four standard errors of mean and deviation at 20,000 samples.
    deviations = np.array([0.3, 0.3, 0.05])
    np.testing.assert_allclose(measured.mean(axis=0) / deviations, 0.0, atol=0.0283)
    np.testing.assert_allclose(measured.std(axis=0) / deviations, 1.0, atol=0.02)
    assert np.abs(np.corrcoef(measured.T) - np.eye(3)).max() < 0.03
    assert robot.measured_pose().tolist() == (robot.pose + measured).tolist()  # until it moves on
    robot.step(np.zeros(2), 0.01)
    again = robot.measured_pose() - robot.pose
    assert abs(np.corrcoef(measured[:, 0], again[:, 0])[0, 1]) < 0.03


def test_noise_is_seeded_and_does_not_move_the_robot():
    def measurements(seed, heading_noise=0.1):
        plant = PlantSettings(position_noise=0.1, heading_noise=heading_noise, seed=seed)
        robot = Unicycle(np.zeros(3), plant)
        found = []
        for _ in range(5):
            robot.step(np.array([1.0, 0.0]), 0.1)
            found.append(robot.measured_pose())
        np.testing.assert_allclose(robot.pose, [0.5, 0.0, 0.0], atol=1e-12)
        return np.array(found)

    np.testing.assert_array_equal(measurements(1), measurements(1))
    assert np.abs(measurements(1) - measurements(2)).max() > 0.01
    np.testing.assert_array_equal(measurements(1, heading_noise=0.0)[:, 2], 0.0)


@settings(max_examples=60)
@given(
    pose=st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0), st.floats(-1e3, 1e3)),
    noise=st.sampled_from([0.0, 0.5]),
)
def test_the_measured_heading_is_wrapped(pose, noise):
    robot = Unicycle(np.array(pose), PlantSettings(heading_noise=noise, position_noise=noise))
    measured = robot.measured_pose()
    assert -math.pi <= measured[2] < math.pi
    assert robot.pose[2] == pose[2]
    if noise == 0.0:
        np.testing.assert_allclose(np.exp(1j * measured[2]), np.exp(1j * pose[2]), atol=1e-12)
        assert measured[:2].tolist() == list(pose[:2])


@settings(max_examples=30)
@given(
    starts=npst.arrays(float, (4, 3), elements=st.floats(-3.0, 3.0)),
    commands=npst.arrays(float, (5, 4, 2), elements=st.floats(-2.0, 2.0)),
    lag=st.sampled_from([0.0, 0.2]),
    delay=st.sampled_from([0.0, 0.04]),
)
def test_a_batch_of_robots_moves_as_single_ones_do(starts, commands, lag, delay):
    plant = PlantSettings(velocity_lag=lag, command_delay=delay, max_linear_vel=1.5)
    together = Unicycle(starts, plant)
    singles = [Unicycle(start, plant) for start in starts]
    for command in commands:
        together.step(command, 0.02)
        for robot, own in zip(singles, command, strict=True):
            robot.step(own, 0.02)
    for index, robot in enumerate(singles):
        np.testing.assert_allclose(together.pose[index], robot.pose, atol=1e-13)
        np.testing.assert_allclose(together.twist[index], robot.twist, atol=1e-13)


def test_the_robot_does_not_share_arrays_with_its_caller():
    start = np.zeros(3)
    robot = Unicycle(start, PlantSettings())
    command = np.array([1.0, 0.0])
    robot.step(command, 1.0)
    assert start.tolist() == [0.0, 0.0, 0.0]
    before = robot.pose
    robot.step(command, 1.0)
    assert before.tolist() == [1.0, 0.0, 0.0]
    robot.measured_pose()[:] = 7.0
    assert robot.pose.tolist() == [2.0, 0.0, 0.0]
