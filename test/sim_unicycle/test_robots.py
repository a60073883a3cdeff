"""Robots with the faults of real ones: against the core's model, closed forms, and by name."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adp_path_follower.cli.options import simulator_options
from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import advance_pose, pose_in_frame
from adp_path_follower.core.path.library import circle
from adp_path_follower.core.robot.history import CommandHistory
from adp_path_follower.core.robot.model import RobotState, advanced
from adp_path_follower.core.robot.robot import model_of, settings_of
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.comparison.controllers import contender
from adp_path_follower.study.simulation.simulate import simulate
from folders import CONFIG
from sim_unicycle.fault_script import without_nodes
from sim_unicycle.settings import PlantSettings, simulator_settings
from sim_unicycle.unicycle import Unicycle

DT = 0.01
REAL = PlantSettings(
    command_delay=0.06,
    velocity_lag=0.1,
    angular_lag=0.2,
    command_ramps=(2.5, 9.0),
    gains=(0.97, 0.92),
    bias=0.03,
)
SENSED = PlantSettings(
    odometry_rate=20.0, odometry_delay=0.03, odometry_jitter=0.01, encoder_noise=(0.01, 0.02)
)
ROBOTS = sorted(file.stem for file in (CONFIG / "robots").glob("*.yaml"))


def commands(count):
    """Return commands that change every tenth of a second, shape (count, 2)."""
    rng = np.random.default_rng(5)
    return np.repeat(rng.uniform([0.0, -1.0], [1.0, 1.0], (count // 10, 2)), 10, axis=0)


def test_the_robot_is_the_one_of_the_cores_model():
    robot, history = Unicycle(np.zeros(3), REAL), CommandHistory()
    history.ramps = REAL.command_ramps
    for step, command in enumerate(commands(400)):
        history.send(step * DT, tuple(command))
        robot.step(command, DT)
    late = -REAL.command_delay
    pieces = []
    for step in range(400):  # what acted in each step, from what was kept of the commands
        pieces += history.held(late + step * DT, late + (step + 1) * DT)
    state = advanced(REAL.model, RobotState(0.0, 0.0, 0.0), pieces)
    np.testing.assert_allclose(robot.pose, [state.x, state.y, state.theta], atol=2e-3)
    np.testing.assert_allclose(
        robot.twist, REAL.model.motion(state.v, state.w), atol=0.05
    )  # its mean over the last step
    assert np.linalg.norm(robot.pose[:2]) > 0.5


def messages(plant, steps=4000, run=0):
    robot, found = Unicycle(np.zeros(3), plant, run), []
    for command in commands(steps):
        robot.step(command, DT)
        found += [(robot.time, reading, command) for reading in robot.arrived]
    return robot, found


def test_odometry_comes_at_its_rate_late_and_noisy_with_the_time_of_measurement():
    _, found = messages(SENSED)
    stamps = np.array([float(reading.time) for _, reading, _ in found])
    np.testing.assert_allclose(np.diff(stamps), 0.05, atol=1e-9)
    late = np.array([arrival for arrival, _, _ in found]) - stamps
    # Half a step more, by rounding up; four standard errors of the mean.
    assert late.mean() == pytest.approx(0.035, abs=4.0 * 0.01 / math.sqrt(len(late)) + 0.001)
    assert late.std() == pytest.approx(0.01, rel=0.15)
    noise = np.array([reading.twist for _, reading, _ in found])
    _, quiet = messages(PlantSettings(odometry_rate=20.0))
    truth = {round(float(reading.time), 6): reading.twist for _, reading, _ in quiet}
    noise -= [truth[round(stamp, 6)] for stamp in stamps.tolist()]
    np.testing.assert_allclose(noise.std(axis=0), [0.01, 0.02], rtol=0.15)


def test_late_odometry_of_a_run_of_a_batch_is_what_it_would_be_alone():
    together = Unicycle(np.zeros((3, 3)), SENSED)
    alone = [Unicycle(np.zeros(3), SENSED, run) for run in range(3)]
    for command in commands(300):
        together.step(np.broadcast_to(command, (3, 2)), DT)
        for robot in alone:
            robot.step(command, DT)
        expected = [robot.measured_motion() for robot in alone]
        np.testing.assert_allclose(together.measured_motion(), expected, atol=1e-12)
        expected = [robot.present_pose() for robot in alone]
        np.testing.assert_allclose(together.present_pose(), expected, atol=1e-12)


def test_dead_reckoned_odometry_knows_no_gains():
    robot, found = messages(PlantSettings(dead_reckoning=True, gains=(0.9, 1.1)), steps=200)
    pose = np.zeros(3)
    for _, reading, _ in found:
        pose = advance_pose(pose, *reading.twist, DT)
    np.testing.assert_allclose(robot.measured_pose(), pose, atol=1e-9)
    assert np.linalg.norm(robot.pose[:2] - pose[:2]) > 0.02


@pytest.mark.parametrize("name", ROBOTS)
def test_robots_have_names_and_other_values_win(name):
    plant, _ = without_nodes(simulator_settings({"robot": name, "command_delay": 0.31}))
    assert plant.command_delay == 0.31
    assert without_nodes(simulator_settings({"robot": name}))[0].ideal == (name == "ideal")
    (option,) = (
        item for item in simulator_options(lambda: None).__click_params__ if item.name == "robot"
    )
    assert name in option.help
    file = CONFIG / "robots" / f"{name}.yaml"
    assert simulator_settings({"robot": str(file)}).plant.model == simulator_settings(
        {"robot": name}
    ).plant.model  # fmt: skip


def test_an_unknown_robot_is_refused_with_those_that_there_are():
    with pytest.raises(AdpError, match=r"robot 'turtle' is neither a file nor one of .*, late, "):
        simulator_settings({"robot": "turtle"})


def test_the_simulation_drives_a_known_robot_as_the_node_does():
    plant = simulator_settings({"robot": "late"}).plant
    path, start = circle(0.5), np.array([0.0, 0.1, 0.1])
    settings = build(
        Settings, {**settings_of(plant.model), "learning": False, "wide_region": "approach"}
    )
    assert model_of(settings) == plant.model
    found = simulate(settings, path, start, duration=3.0, plant=plant, record=True)
    driver = Driver(settings.with_changes(path_start="arc_length", start_arc_length=0.0))
    driver.follow(path)
    robot, sent = Unicycle(pose_in_frame(start, path.frame(0.0).pose), plant), []
    for step in range(300):
        motion = robot.measured_motion()
        sent.append(driver.step(robot.present_pose(), (step + 1) * 10_000_000, motion).command)
        robot.step(sent[-1], DT)
    np.testing.assert_allclose(found.trajectories.command[0, :300], sent, atol=1e-9)
    ideal = simulate(
        settings.with_changes(robot_model="ideal"), path, start, duration=3.0, plant=plant
    )
    assert found.cost[0] < ideal.cost[0]


def test_each_controller_is_asked_for_with_a_model_of_its_robot():
    model = simulator_settings({"robot": "late"}).plant.model
    settings = build(Settings, {"robot_model": "learned"})
    names = ["adp", "lqr", "lqr+learned", "paper", "paper+given"]
    found = {
        item.name: item.settings.robot.robot_model
        for item in [contender(name, settings) for name in names]
    }
    assert found == dict(zip(names, ["learned", "ideal", "learned", "ideal", "given"], strict=True))
    given = contender("stanley+given", settings, model)
    assert model_of(given.settings) == model
    with pytest.raises(AdpError, match=r"'lqr.true' has the robot model 'true', but must have one"):
        contender("lqr+true", settings)
