"""The controller learns the robot that it drives, and does no harm where there is nothing to."""

import dataclasses
import math

import numpy as np
import pytest
from drives import drive, ours, start_pose
from margins import Faulty, driven
from paths import bend, corners
from plants import AnalyticPlant
from robots import TYPICAL, Robot

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.geometry import advance_pose
from adp_path_follower.core.learning.weights_file import decode, encode
from adp_path_follower.core.path.library import circle
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

PATH = bend()
START = (0.0, 0.1, -0.2)
KINDS = ("learned", "ideal")


def settings(model="learned", **values):
    return build(Settings, {"robot_model": model, **values})


def run(robot, duration=16.0, path=PATH, tuning=None, seen=None):
    tuning = tuning or settings()
    plant = AnalyticPlant(robot, start_pose(path, START))
    return drive(plant, ours(tuning, path, seen), path, tuning, duration)


class Models:
    """Keeps the models that drove."""

    def __init__(self):
        self.driver, self.found = None, []

    def __call__(self, time, driver, output):
        """Note that of a step."""
        self.driver = driver
        self.found.append(driver.robot.model)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_finds_the_robot(seed):
    robot = dataclasses.replace(TYPICAL, seed=seed)
    models = Models()
    outcome = run(robot, seen=models)
    model, (gain, turn_gain, bias) = models.found[-1], robot.gains
    assert model.delay + model.angular_lag == pytest.approx(robot.delay + robot.lag, abs=0.03)
    assert model.delay == pytest.approx(robot.delay, abs=0.04)
    assert model.ramp == pytest.approx(robot.ramp, rel=0.3)
    assert model.linear_gain == pytest.approx(gain, abs=0.006)
    assert model.angular_gain == pytest.approx(turn_gain, abs=0.025)
    assert model.bias == pytest.approx(bias, abs=0.01)
    assert models.driver.robot.report["explained"] > 0.5
    assert outcome.rms < 0.005  # the noise of the position
    ideal = run(robot, tuning=settings("ideal"))
    assert outcome.rms < 0.5 * ideal.rms
    assert outcome.cost < ideal.cost
    assert outcome.variation < ideal.variation


def test_a_robot_that_is_given_is_driven_as_well():
    gain, turn_gain, bias = TYPICAL.gains
    given = settings(
        "given",
        actuation_delay=TYPICAL.delay,
        robot_lags=[TYPICAL.lag, TYPICAL.lag],
        robot_ramps=TYPICAL.ramps,
        robot_gains=[gain, turn_gain],
        robot_bias=bias,
    )
    models = Models()
    outcome = run(TYPICAL, tuning=given, seen=models)
    assert outcome.rms < 0.004
    assert len(set(models.found)) == 1


def test_an_ideal_robot_is_driven_as_before():
    learned, ideal = run(Robot(), 12.0), run(Robot(), 12.0, tuning=settings("ideal"))
    assert learned.trace.tolist() == ideal.trace.tolist()


def test_without_its_motion_the_known_delay_is_predicted_all_the_same():
    known = {"actuation_delay": 0.1}
    drivers = Driver(settings(**known)), Driver(settings("ideal", **known))
    pose, time = np.array([0.1, -0.2, 0.3]), 0
    for driver in drivers:
        driver.follow(circle(0.5))
    for _ in range(20):
        time += 10_000_000
        found = [driver.step(pose, time).command.tolist() for driver in drivers]
        assert found[0] == found[1]


def test_two_drives_are_equal_to_the_last_bit():
    first, second = run(TYPICAL, 5.0), run(TYPICAL, 5.0)
    assert first.trace.tolist() == second.trace.tolist()


def test_gains_stay_where_the_pose_is_reckoned_from_the_encoders():
    robot = dataclasses.replace(TYPICAL, dead_reckoned=True)
    models = Models()
    run(robot, seen=models)
    model = models.found[-1]
    assert model.linear_gain == pytest.approx(1.0, abs=0.003)
    assert model.angular_gain == pytest.approx(1.0, abs=0.01)
    assert model.bias == pytest.approx(0.0, abs=0.004)


def test_reset_forgets_the_robot():
    models = Models()
    run(TYPICAL, 5.0, seen=models)
    assert models.driver.robot.model.delay > 0.0
    models.driver.reset_learning()
    assert models.driver.robot.model.ideal


@pytest.mark.parametrize("order", ["ideal given", "given ideal", "given given", "learned given"])
def test_another_model_takes_over_without_a_jump_of_the_command(order):
    limits = {"max_angular_accel": 3.0, "max_linear_accel": 1.0, "max_linear_decel": 1.0}
    given = {"robot_gains": [1.1, 0.9], "robot_lags": [0.1, 0.1]}
    known = {"ideal": {}, "learned": {}, "given": given}
    kinds = [settings(kind, **limits, **known[kind]) for kind in order.split()]
    if kinds[0] == kinds[1]:
        kinds[1] = kinds[1].with_changes(robot_gains=[0.9, 1.1])
    driver = Driver(kinds[0])
    driver.follow(PATH)
    pose, twist, commands = start_pose(PATH, START), np.zeros(2), []
    for step in range(1, 301):
        if step == 150:
            driver.take_over(driver.prepared(kinds[1]))
        output = driver.step(pose, 10_000_000 * step, np.array([*twist, 0.0]))
        twist = output.command
        pose = advance_pose(pose, *twist, 0.01)
        commands.append(output.command)
    assert (np.abs(np.diff(commands, axis=0)) <= [0.01 + 1e-9, 0.03 + 1e-9]).all()
    assert commands[149][0] > 0.3  # it was driving


def test_encoders_with_the_wrong_sign_do_no_more_harm_than_before():
    class Reversed(AnalyticPlant):
        def arrived(self):
            return [
                dataclasses.replace(found, twist=found.twist * [1.0, -1.0])
                for found in super().arrived()
            ]

    found = {}
    for model in ("learned", "ideal"):
        tuning = settings(model)
        plant = Reversed(TYPICAL, start_pose(PATH, START))
        found[model] = drive(plant, ours(tuning, PATH), PATH, tuning, 16.0)
    assert math.isfinite(found["learned"].cost)
    assert found["learned"].rms < max(0.02, 1.3 * found["ideal"].rms)


@pytest.mark.parametrize("fault", ["slip", "carried", "jump", "dropout"])
def test_a_fault_is_not_taken_for_the_robot(fault):
    plant = type("Plant", (Faulty,), {"kind": fault})
    learned, ideal = (driven(kind, plant, TYPICAL) for kind in KINDS)
    assert learned.cost < ideal.cost
    assert learned.rms < ideal.rms


def held(driver, pose, begun, seconds):
    """Return the commands to a robot that stays where it is, as with its emergency stop pressed."""
    times = begun + 10_000_000 * np.arange(1, round(100 * seconds))
    return [driver.step(pose, int(time), np.zeros(3)).command.tolist() for time in times]


def test_a_robot_that_is_held_is_not_taken_for_a_slow_one():
    pose, found = start_pose(PATH, START), {}
    for model in ("learned", "ideal"):
        driver = Driver(settings(model))
        driver.follow(PATH)
        found[model] = held(driver, pose, 0, 6.0)
    assert found["learned"] == found["ideal"]

    models = Models()
    outcome = run(TYPICAL, 10.0, seen=models)
    before = models.found[-1]
    last = outcome.trace[-1]
    held(models.driver, last[1:4], round(1e9 * (last[0] + 0.2)), 20.0)
    after = models.driver.robot.model
    assert after.delay == pytest.approx(before.delay, abs=0.02)
    assert after.angular_lag == pytest.approx(before.angular_lag, abs=0.02)
    assert after.linear_gain == pytest.approx(before.linear_gain, abs=0.003)


def test_it_is_held_on_the_path_against_what_its_model_does_not_know():
    robot = Robot(lag=0.1, wheel_difference=0.01)
    found = []
    for tight_within in (0.0, 0.01):
        tuning = settings("given", robot_lags=(0.1, 0.1), tight_within=tight_within)
        found.append(run(robot, tuning=tuning).rms)
    assert found[1] < 0.5 * found[0]


def test_a_slow_robot_brakes_before_corners():
    robot = Robot(track=0.4, ramp=1.3, lag=0.1, delay=0.1)
    found = {
        model: run(robot, 12.0, corners(), settings(model, desired_speed=1.0)) for model in KINDS
    }
    assert found["learned"].rms < 0.15 * found["ideal"].rms
    assert found["learned"].cost < found["ideal"].cost


def test_the_robot_is_saved_with_the_weights():
    models = Models()
    run(TYPICAL, 4.0, seen=models)
    driver = models.driver
    saved = dataclasses.replace(driver.follower.saved_weights(), robot=driver.robot.learned)
    read = decode(encode(saved), "file")
    assert read.robot == dataclasses.astuple(driver.robot.model)
    assert Driver(settings(), read).robot.model == driver.robot.model
    assert Driver(settings("ideal"), read).robot.model.ideal
    wrong = dataclasses.replace(saved, robot=(*saved.robot[:3], math.nan, *saved.robot[4:]))
    with pytest.raises(FileError, match="robot"):
        decode(encode(wrong), "file")


def test_parameters_stay_within_their_bounds_on_an_impossible_robot():
    robot = dataclasses.replace(TYPICAL, radius_error=0.4, wheel_difference=0.6)
    models = Models()
    outcome = run(robot, 6.0, seen=models)
    assert np.isfinite(outcome.trace).all()
    for model in models.found:
        assert 0.88 <= model.linear_gain <= 1.12
        assert 0.8 <= model.angular_gain <= 1.25
        assert abs(model.bias) <= 0.15
