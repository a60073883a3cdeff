"""Weights files: the next run goes on to the last bit, and what does not fit is one sentence."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from click.testing import CliRunner

from adp_path_follower.cli import main
from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.geometry import advance_pose, pose_in_frame
from adp_path_follower.core.learning.weights_file import decode, encode, read_weights, write_weights
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build, update

PERIOD = 10_000_000  # [ns]
SMALL = {"basis_degree": 4, "sample_count": 128, "samples_per_step": 128}
ONE_SET = {"scheduling": "path_state", "basis": "paper", "frame": "serret_frenet"}
LEARNERS = {"arc_length": SMALL, "path_state": {**ONE_SET, "samples_per_axis": [3, 3, 3, 3]}}


def drive(driver, path, steps=60, pose=(0.02, 0.2, 0.5), time=0):
    """Drive an ideal robot; return its commands and weights, and where it ends."""
    if driver.route is None:
        driver.follow(path)
    pose, told = np.array(pose, float), []
    for step in range(steps):
        output = driver.step(pose, time + (step + 1) * PERIOD)
        weights = output.weights
        told.append(np.concatenate([output.command, weights.critic, weights.actor]))
        pose = advance_pose(pose, *output.command, PERIOD * 1e-9)
    return np.array(told), pose


@pytest.fixture(scope="module", params=LEARNERS)
def learned(request):
    """Return a driver that has learned for a while, where its robot is, and its path."""
    driver, path = Driver(build(Settings, LEARNERS[request.param])), named_path("circle:0.7")
    _, pose = drive(driver, path)
    return driver, pose, path


def the_bytes(driver):
    return encode(driver.follower.saved_weights())


def test_a_run_from_the_file_is_the_run_that_went_on_from_a_stop(learned, tmp_path):
    first, pose, path = learned
    content = the_bytes(first)
    write_weights(tmp_path / "weights.npz", content)
    saved, same = read_weights(tmp_path / "weights.npz", first.settings)
    assert same == content
    complaints = []
    second = Driver(first.settings, saved, complaints.append)
    cold = Driver(first.settings)
    again = Driver(first.settings)  # another robot, that was driven alike and then carried
    drive(again, path)
    again.restart()
    expected, _ = drive(again, path, pose=pose, time=10**9)
    found, _ = drive(second, path, pose=pose, time=10**9)
    np.testing.assert_array_equal(found, expected)
    assert not complaints
    assert not np.array_equal(drive(cold, path, 1, pose)[0], expected[:1])


def test_what_is_saved_is_what_is_read(learned):
    saved = learned[0].follower.saved_weights()
    found = decode(encode(saved), "it")
    assert dict(found.settings) == dict(saved.settings)
    for field in dataclasses.fields(saved.learned):
        np.testing.assert_array_equal(
            getattr(found.learned, field.name), getattr(saved.learned, field.name)
        )


def test_weights_are_forgotten_on_demand(learned):
    first, pose, path = learned
    saved = first.follower.saved_weights()
    driver = Driver(first.settings, saved)
    driver.reset_learning()
    found, _ = drive(driver, path, 3, pose)
    np.testing.assert_array_equal(found, drive(Driver(first.settings), path, 3, pose)[0])
    driver = Driver(first.settings, saved)
    drive(driver, path, 3, pose)
    driver.reset_learning()
    driver.restart()
    assert driver.saved_weights is None


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"desired_speed": 0.25}, "with desired_speed 0.5, where 'desired_speed' is 0.25 now"),
        ({"input_cost": [1.0, 2.0]}, "with input_cost [1.0, 1.0], where 'input_cost' is [1.0, 2.0"),
        ({"max_linear_vel": float("inf")}, "where 'max_linear_vel' is .inf now"),
    ],
)
def test_another_problem_is_refused(learned, tmp_path, change, told):
    driver = learned[0]
    file = tmp_path / "weights.npz"
    write_weights(file, the_bytes(driver))
    with pytest.raises(FileError) as refusal:
        read_weights(file, update(driver.settings, change))
    assert told in str(refusal.value)
    assert str(file) in str(refusal.value)
    assert "leave 'weights_file' empty" in str(refusal.value)


def test_what_does_not_change_the_problem_does_not_matter(learned, tmp_path):
    driver = learned[0]
    write_weights(tmp_path / "weights.npz", the_bytes(driver))
    other = {"actor_gain": 3.0, "odom_timeout": 1.0, "controller_frequency": 50.0}
    read_weights(tmp_path / "weights.npz", update(driver.settings, other))


def test_settings_that_changed_before_the_first_step_are_told_then(learned):
    first, pose, path = learned
    complaints = []
    driver = Driver(first.settings, first.follower.saved_weights(), complaints.append)
    driver.take_over(driver.prepared(update(first.settings, {"desired_speed": 0.25})))
    found, _ = drive(driver, path, 3, pose)
    cold = Driver(driver.settings)
    np.testing.assert_array_equal(found, drive(cold, path, 3, pose)[0])
    assert len(complaints) == 1
    assert "desired_speed" in complaints[0]


@pytest.mark.parametrize(
    ("name", "told"), [("circle:0.6", "a closed one of 10.47 m"), ("line", "an open one of")]
)
def test_weights_along_another_path_are_not_used(name, told):
    path = named_path(name)
    first = Driver(build(Settings, SMALL))
    _, pose = drive(first, named_path("circle:0.7"))
    complaints = []
    driver = Driver(first.settings, first.follower.saved_weights(), complaints.append)
    found, _ = drive(driver, path, 3, pose)
    np.testing.assert_array_equal(found, drive(Driver(first.settings), path, 3, pose)[0])
    (complaint,) = [text for text in complaints if "left out" not in text]  # another warning
    assert told in complaint
    assert "\n" not in complaint


def test_a_path_as_long_that_bends_elsewhere_is_another():
    def bent(side):
        angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 80)
        arc = np.column_stack([2.0 + 0.8 * np.cos(angle), side * (0.8 + 0.8 * np.sin(angle))])
        straight = np.column_stack([np.linspace(0.0, 1.97, 40), np.zeros(40)])
        return Path.from_points(np.vstack([straight, arc]))

    first = Driver(build(Settings, SMALL))
    drive(first, bent(1.0), 200, pose=(1.0, 0.0, 0.0))
    complaints = []
    driver = Driver(first.settings, first.follower.saved_weights(), complaints.append)
    drive(driver, bent(-1.0), 2)
    assert len(complaints) == 1
    assert "bends elsewhere" in complaints[0]


def test_a_path_that_was_moved_and_turned_is_the_same():
    """Odometry begins anew at every start of a robot, and its paths with it."""
    first, path = Driver(build(Settings, SMALL)), named_path("lissajous")
    _, pose = drive(first, path)
    frame = np.array([30.0, -7.0, 2.0])
    moved = Path.from_points(pose_in_frame(path.points(0.02), frame)[:, :2])
    same = Path.from_points(path.points(0.02)[:, :2])
    complaints = []
    drivers = [
        Driver(first.settings, first.follower.saved_weights(), complaints.append) for _ in range(2)
    ]
    there, _ = drive(drivers[0], moved, 1, pose_in_frame(pose, frame))
    here, _ = drive(drivers[1], same, 1, pose)
    assert not complaints
    # The nearest places differ by rounding, and by no more than their raster.
    np.testing.assert_allclose(there[0, :2], here[0, :2], atol=1e-4)


def test_a_batch_of_robots_starts_from_one_set_of_weights(learned):
    driver, _, path = learned
    follower = PathFollower(driver.settings, path, np.zeros(3))
    assert follower.start_from(driver.follower.saved_weights()) == ""
    poses = np.array([[0.0, 0.1, 0.0], [0.1, 0.0, 0.2], [0.0, -0.1, 0.1]])
    assert np.isfinite(follower.step(poses, 0.01).command).all()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((), ""),
        (("--path", "line"), "does not hold for this path: they were learned along a closed"),
        (("--set", "desired_speed=0.3"), "belongs to other settings"),
    ],
)
def test_simulations_start_from_a_file(tmp_path, arguments, told):
    driver = Driver(build(Settings, {}))
    drive(driver, named_path("circle:0.7"), 150)
    file = tmp_path / "weights.npz"
    write_weights(file, the_bytes(driver))
    common = ["simulate", "--path", "circle:0.7", "--duration", "0.2", "--weights", str(file)]
    common += ["--learning", "frozen", "--json", str(tmp_path / "runs.json")]
    done = CliRunner().invoke(main.adp, [*common, *arguments])
    if told:
        assert isinstance(done.exception, FileError)
        assert told in str(done.exception)
        return
    assert done.exit_code == 0, done.output
    (run,) = json.loads((tmp_path / "runs.json").read_text())["runs"]
    learned = driver.follower.saved_weights().learned
    assert learned.knots[:2].tolist() == [0, 1]
    low, high = np.sort(learned.critic[:2], axis=0)  # the target ends between these two knots
    critic = np.array(run["critic_weights"])
    assert ((low - 1e-12 <= critic) & (critic <= high + 1e-12)).all()
    assert np.abs(critic[6:]).max() > 0.01  # beyond the Riccati solution's six


def test_weights_that_are_not_finite_are_not_saved(learned):
    saved = learned[0].follower.saved_weights()
    broken = dataclasses.replace(saved.learned, critic=saved.learned.critic * np.nan)
    with pytest.raises(FileError, match="not finite"):
        encode(dataclasses.replace(saved, learned=broken))
