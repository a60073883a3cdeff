"""`adp identify` on bags of robots that are known, driven by the plant of the bench."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from plants import STEP
from robots import TYPICAL, Robot

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.robot.robot import model_of
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import build
from bag_messages import SECOND, odometry, twist_stamped, write_bag, write_foreign
from commands import adp
from driven_robots import BEGIN, driven, slalom, straight
from sim_unicycle.settings import PlantSettings, simulator_settings
from sim_unicycle.unicycle import Unicycle


def identified(folder, bag, *options):
    out = folder / "out"
    done = adp("identify", str(bag), "--out", str(out), "--json", str(folder / "it.json"), *options)
    assert done.returncode == 0, done.stderr
    numbers = json.loads((folder / "it.json").read_text())
    assert (out / "robot.png").stat().st_size > 10_000
    return numbers, out / "robot.yaml", done


def check(numbers, truth, room):
    """Assert that each true value is in its interval, or as near to it as the room says."""
    for name, value in truth.items():
        found = numbers["parameters"][name]
        assert found["low"] - room.get(name, 0.0) <= value <= found["high"] + room.get(name, 0.0), (
            name, value, found,
        )  # fmt: skip


def test_a_robot_is_found_from_a_bag_of_nav2(tmp_path):
    """Commands without stamps at 20 Hz, odometry by another name, written by another program."""
    bag = write_foreign(tmp_path / "nav2", driven(TYPICAL, slalom))
    numbers, file, done = identified(tmp_path, bag)
    gain, turn_gain, bias = TYPICAL.gains
    truth = {
        "delay": TYPICAL.delay,
        "linear lag": TYPICAL.lag,
        "angular lag": TYPICAL.lag,
        "k_v": gain,
        "k_w": turn_gain,
        "bias": bias,
        "noise of v": TYPICAL.linear_noise,
        "noise of w": TYPICAL.angular_noise,
        "noise of x, y": TYPICAL.position_noise,
        "noise of heading": TYPICAL.heading_noise,
        "odometry rate": TYPICAL.odometry_rate,
        "odometry latency": TYPICAL.latency,
        "odometry jitter": TYPICAL.jitter,
    }
    # Times come in steps of the plant; the ramp is that of each wheel, not of v and of w alone.
    room = {"delay": 0.01, "angular lag": 0.01, "odometry latency": STEP, "odometry jitter": 1e-3}
    room |= {"noise of v": 1e-3, "noise of w": 2e-3, "k_v": 1e-3, "k_w": 2e-3}
    check(numbers, truth, room)
    assert all(item["high"] - item["low"] < 0.08 for name, item in numbers["parameters"].items()
               if "lag" in name or name in ("delay", "k_v", "k_w", "bias"))  # fmt: skip
    assert min(numbers["explained"].values()) > 0.98
    assert "not told" not in done.stdout
    settings = load_settings(Settings, "path_follower", file)
    assert settings.robot.robot_model == "given"
    plant = simulator_settings({"robot": str(file)}).plant
    assert model_of(settings) == plant.model
    assert plant.model.delay == pytest.approx(numbers["parameters"]["delay"]["value"], rel=1e-4)
    assert plant.odometry_rate == pytest.approx(30.0, rel=0.02)


def straight_at_once(time):
    """Drive from the first message on, as a recorder that waits for commands hears it."""
    return 0.3, 0.0


def slowly(time):
    """Creep with steps of 8 mm/s, within the noise and far below any ramp."""
    return 0.02 if (time // 4.0) % 2 else 0.012, 0.05 * np.sin(1.3 * time)


@pytest.mark.parametrize(("drive", "noise"), [(straight_at_once, 0.0), (slowly, 0.002)])
def test_a_robot_without_ramps_gets_none(tmp_path, drive, noise):
    robot = Unicycle(np.zeros(3), PlantSettings(command_delay=0.2, velocity_lag=0.15))
    random, messages = np.random.default_rng(1), []
    for step in range(2000):
        now = 1000 * SECOND + step * SECOND // 50
        wheels = robot.twist + noise * random.normal(size=2)
        messages.append(("/odom", now, odometry(now, *robot.measured_pose(), *wheels)))
        command = np.array(drive(step / 50.0))
        messages.append(("/cmd_vel", now + 1, twist_stamped(now + 1, *command)))
        robot.step(command, 0.02)
    numbers, *_ = identified(tmp_path, write_bag(tmp_path / "bag", messages))
    # Encoders tell the mean of the last period, so half of it counts as delay.
    check(numbers, {"delay": 0.21, "linear lag": 0.15}, {"delay": 0.005, "linear lag": 0.005})
    assert not [name for name in numbers["parameters"] if "ramp" in name]


def test_the_path_for_it_excites_every_parameter(tmp_path):
    plant = simulator_settings({"robot": "late"}).plant
    settings = build(Settings, {"learning": False, "wide_region": "approach"})
    driver, robot = Driver(settings), Unicycle(np.zeros(3), plant)
    driver.follow(named_path("identify"))
    messages, step = [], 0
    while not driver.at_goal and step < 4000:
        now = BEGIN + step * 10_000_000
        motion = robot.measured_motion()
        command = driver.step(robot.present_pose(), now, motion).command
        messages.append(("/cmd_vel", now, twist_stamped(now, *command)))
        robot.step(command, 0.01)
        step += 1
        for item in robot.arrived:
            stamp = BEGIN + round(float(item.time) * SECOND)
            measured = odometry(stamp, *item.pose, *item.twist.tolist())
            messages.append(("/odom", now + 10_000_000, measured))
    assert driver.at_goal
    numbers, _, _ = identified(tmp_path, write_bag(tmp_path / "bag", messages))
    model = plant.model
    truth = {"delay": model.delay, "linear lag": model.linear_lag, "angular lag": model.angular_lag}
    truth |= {"k_v": model.linear_gain, "k_w": model.angular_gain, "bias": model.bias}
    # Encoders report the mean over a step, which is half a step old.
    check(
        numbers,
        {**truth, "linear ramp": model.ramp},
        {"delay": 0.005, "k_w": 5e-3, "linear ramp": 0.1},
    )


def test_a_straight_drive_does_not_tell_how_the_robot_turns(tmp_path):
    bag = write_bag(tmp_path / "bag", driven(TYPICAL, straight, duration=15.0))
    numbers, file, done = identified(tmp_path, bag)
    for name in ("angular lag", "k_w"):
        assert numbers["parameters"][name]["drive"] == "turn to both sides, as in a slalom"
    assert not numbers["parameters"]["k_v"]["drive"]
    assert "--path identify is a short slalom" in done.stderr
    model = model_of(load_settings(Settings, "path_follower", file))
    assert (model.angular_lag, model.angular_gain) == (0.0, 1.0)
    assert model.linear_gain == pytest.approx(TYPICAL.gains[0], abs=0.01)


def test_an_ideal_robot_is_found_ideal_and_reckoned_poses_are_not_trusted(tmp_path):
    reckoned = dataclasses.replace(TYPICAL, dead_reckoned=True, position_noise=0.0,
                                   heading_noise=0.0)  # fmt: skip
    numbers, _, done = identified(tmp_path, write_bag(tmp_path / "bag", driven(reckoned, slalom)))
    check(numbers, {"k_v": 1.0, "k_w": 1.0, "bias": 0.0}, {"k_v": 2e-3, "k_w": 2e-3, "bias": 2e-3})
    assert "name a localised pose by --pose" in done.stderr
    (tmp_path / "ideal").mkdir()
    bag = write_bag(tmp_path / "ideal" / "bag", driven(Robot(), slalom, stamped=True))
    numbers, _, _ = identified(tmp_path / "ideal", bag)
    check(numbers, {"delay": 0.0, "linear lag": 0.0, "angular lag": 0.0, "k_v": 1.0}, {"k_v": 1e-3})
    assert numbers["parameters"]["angular lag"]["value"] < 0.01


@pytest.mark.parametrize(
    ("kept", "expected"),
    [
        ("/robot/odometry", "has no commands: name a topic by --cmd, or record it"),
        ("/cmd_vel", "has no odometry: name a topic by --odom, or record it"),
    ],
)
def test_a_bag_without_what_is_needed_is_one_sentence(tmp_path, kept, expected):
    messages = [item for item in driven(TYPICAL, straight, duration=2.0) if item[0] == kept]
    done = adp("identify", str(write_bag(tmp_path / "bag", messages)), "--out", str(tmp_path / "o"))
    assert done.returncode == 2
    assert expected in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("wanted", "still", "expected"),
    [
        (lambda time: (0.0, 0.0), False, "has no command to move"),
        (straight, True, "has no odometry with velocities"),
    ],
)
def test_a_robot_that_stands_is_one_sentence(tmp_path, wanted, still, expected):
    messages = [
        (topic, time, odometry(time, 0.0, 0.0, 0.0) if still and "odom" in topic else message)
        for topic, time, message in driven(TYPICAL, wanted, duration=2.0)
    ]
    done = adp("identify", str(write_bag(tmp_path / "bag", messages)), "--out", str(tmp_path / "o"))
    assert done.returncode == 2
    assert expected in done.stderr
    assert done.stderr.count("\n") == 1
