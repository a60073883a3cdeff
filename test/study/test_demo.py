"""All four nodes: determinism, equality with the ROS-free loop, and recordings that survive."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path as FilePath

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from mcap.records import Message
from mcap.stream_reader import StreamReader
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from adp_path_follower.analysis.bag_analysis import analyse_bag
from adp_path_follower.analysis.metrics import METRICS
from adp_path_follower.bags.reader import read_run
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import lissajous, named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.messages.topics import RUN_TOPICS
from adp_path_follower.resources import config_file
from adp_path_follower.study.demo import run_closed_loop
from adp_path_follower.study.replay.replay import replay
from adp_path_follower.study.simulation.simulate import PAPER_START, simulate
from commands import adp

pytestmark = pytest.mark.nodes

DURATION = 5.0  # [s] simulated


@pytest.fixture(scope="module")
def paper() -> Settings:
    return load_settings(Settings, "path_follower", config_file("paper.yaml"))


@pytest.fixture(scope="module")
def bags(tmp_path_factory, paper) -> list[FilePath]:
    """Return two recordings of the same run."""
    return [
        run_closed_loop(
            paper,
            lissajous(),
            "lissajous",
            np.array(PAPER_START),
            DURATION,
            tmp_path_factory.mktemp("run"),
            lambda progress: None,
        )
        for _ in range(2)
    ]


# It starts without weights, follows a path on the topic, and drives an ideal robot.
NOT_IN_THIS_RUN = ("initial_weights", "goal_path", "robot_model")


def test_every_step_is_recorded(bags):
    for bag in bags:
        run = read_run(bag)
        steps = round(100 * DURATION) + 1
        for topic in RUN_TOPICS:
            key = topic.removeprefix("path_follower/")
            if key in NOT_IN_THIS_RUN:
                assert f"/{topic.lstrip('/')}" not in run.message_counts
            elif key.startswith("/tf"):  # where tf2_msgs is installed
                continue
            elif key in ("path", "configuration", "status", "/diagnostics"):
                assert run.message_counts[f"/{topic.lstrip('/')}"] >= 1
            else:
                assert len(np.unique(run.series[key].values, axis=0)) > 0.9 * steps
                assert len(run.series[key].stamp) >= steps
        assert len(np.unique(run.series["odom"].stamp)) == steps


def test_recorded_commands_are_those_of_path_follower_to_the_last_bit(bags):
    for bag in bags:
        again = replay(read_run(bag))
        assert len(again.steps.stamp) == round(100 * DURATION) + 1
        assert again.identical.all()
        # Not trivially so: another gain gives other commands.
        assert np.ptp(again.recorded[:, 0]) > 0.1


def test_recorded_weights_are_those_of_path_follower_to_the_last_bit(bags):
    run = read_run(bags[0])
    again = replay(run)
    expected = np.array([output.weights.critic for output in again.outputs])
    assert np.array_equal(run.series["critic_weights"].values, expected)


def test_two_runs_give_the_same_commands(bags):
    first, second = (replay(read_run(bag)) for bag in bags)
    assert np.array_equal(first.steps.stamp, second.steps.stamp)
    assert np.array_equal(first.recorded, second.recorded)
    assert np.array_equal(first.steps.pose, second.steps.pose)


def test_ros_run_equals_the_ros_free_run(bags, paper):
    run = read_run(bags[0])
    again = replay(run)
    # The nodes follow the path through the published poses, so the simulation must, too.
    path = Path.from_points(run.paths[-1][1][:, :2])
    alone = simulate(paper, path, duration=DURATION, record=True)
    assert np.allclose(alone.trajectories.command[0], again.recorded, rtol=0.0, atol=1e-9)
    assert np.allclose(
        alone.trajectories.critic_weights[0],
        run.series["critic_weights"].values,
        rtol=0.0,
        atol=1e-9,
    )
    # And the path through the poses is the paper's, to what the cost can tell.
    exact = simulate(paper, named_path("lissajous"), duration=DURATION)
    assert alone.cost[0] == pytest.approx(exact.cost[0], rel=1e-4)


def _readable(file: FilePath) -> list[Message]:
    """Return the messages of a torn file up to where it is torn."""
    messages = []
    with file.open("rb") as stream:
        try:
            records = StreamReader(stream).records
            messages.extend(record for record in records if isinstance(record, Message))
        except Exception:  # whatever a tear looks like to the reader
            return messages
    return messages


def test_a_killed_recorder_loses_less_than_a_second(peer, start, tmp_path):
    bag = tmp_path / "bag"
    odometry = peer.listen(Odometry, "odom")
    start("sim_unicycle")
    recorder = start("recorder", output=str(bag))
    peer.until(lambda: "recording /odom" in recorder.output(), "the recorder")
    count = len(odometry)
    peer.until(lambda: len(odometry) > count + 300, "three seconds of odometry")
    killed_at = time.time_ns()
    recorder.stop(signal.SIGKILL)
    messages = _readable(bag / "bag_0.mcap")
    assert len(messages) > 150
    assert killed_at - messages[-1].publish_time < 1_000_000_000
    assert (bag / "metadata.yaml").read_text().startswith("rosbag2_bagfile_information:")


def test_recorder_refuses_to_overwrite(start, tmp_path):
    (tmp_path / "bag").mkdir()
    node = start("recorder", output=str(tmp_path / "bag"))
    assert node.process.wait(30.0) == 2
    assert "exists already: choose another name" in node.output()


def test_simulator_in_real_time_publishes_a_clock_that_runs_as_fast_as_asked(peer, start):
    clock = peer.listen(Clock, "/clock")
    odometry = peer.listen(Odometry, "odom")
    start("sim_unicycle", publish_clock=True, real_time_factor=5.0, rate=50.0)
    peer.until(lambda: len(clock) > 500, "ten simulated seconds")
    times = np.array([c.clock.sec + 1e-9 * c.clock.nanosec for c in clock])
    assert np.allclose(np.diff(times), 0.02, atol=1e-6)
    last = odometry[-1].header.stamp
    assert last.sec + 1e-9 * last.nanosec == pytest.approx(times[-1], abs=0.1)


def test_simulator_moves_as_told_and_stops_without_commands(peer, start):
    truth = peer.listen(Odometry, "ground_truth")
    commands = peer.node.create_publisher(TwistStamped, "cmd_vel", 10)
    start("sim_unicycle", publish_clock=True, rate=100.0)
    peer.until_matched(commands)
    command = TwistStamped()
    command.twist.linear.x, command.twist.angular.z = 1.0, 2.0
    timer = peer.node.create_timer(0.05, lambda: commands.publish(command))
    peer.until(lambda: truth and truth[-1].twist.twist.linear.x == 1.0, "motion")
    count = len(truth)
    peer.until(lambda: len(truth) > count + 100, "a second of motion")
    # Constant twist: every position is on a circle of radius v / w about (0, 0.5).
    positions = np.array([[t.pose.pose.position.x, t.pose.pose.position.y] for t in truth])
    assert np.allclose(np.hypot(positions[:, 0], positions[:, 1] - 0.5), 0.5, atol=1e-9)
    peer.node.destroy_timer(timer)
    peer.until(lambda: truth and truth[-1].twist.twist.linear.x == 0.0, "the stop without commands")
    assert peer.call(Trigger, "unicycle_sim/reset").success
    count = len(truth)
    peer.until(lambda: len(truth) > count + 5, "odometry after the reset")
    assert truth[-1].pose.pose.position.x == 0.0


@pytest.mark.parametrize(
    ("executable", "parameters", "expected"),
    [
        ("path_publisher", {"path": "spiral"}, "unknown path 'spiral'"),
        ("path_publisher", {"path": "missing.csv"}, "file missing.csv cannot be read"),
        ("path_publisher", {"spacing": 0.0}, "setting 'spacing' is 0.0"),
        ("sim_unicycle", {"rate": 0.0}, "setting 'rate' is 0.0"),
        ("sim_unicycle", {"real_time_factor": 2.0}, "must be 1 unless publish_clock is true"),
        ("recorder", {"topcs": ("odom",)}, "unknown setting 'topcs'; did you mean 'topics'?"),
    ],
)
def test_other_nodes_refuse_bad_settings_in_one_sentence(start, executable, parameters, expected):
    node = start(executable, **parameters)
    assert node.process.wait(30.0) == 2
    assert expected in node.output()
    assert len(node.output().strip().splitlines()) == 1


def _demo(folder: FilePath, *arguments: str, **environment: str) -> FilePath:
    """Return the directory that `adp demo` leaves in a folder."""
    done = subprocess.run(
        [sys.executable, "-m", "adp_path_follower.cli.main", "demo", *arguments],
        env={**os.environ, **environment},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    (folder / "printed").write_text(done.stdout, encoding="utf-8")
    (directory,) = folder.glob("adp_demo_*")
    return directory


def test_the_command_ends_at_the_goal(tmp_path):
    (tmp_path / "short.csv").write_text("x,y\n0,0\n1,0.1\n2,0\n")
    done = adp("demo", "--path", "short.csv", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (directory,) = tmp_path.glob("adp_demo_*")
    content = json.loads((directory / "summary.json").read_text())
    # 2 m at 0.5 m/s, and 0.5 m that the robot starts behind.
    assert 3.5 < content["duration"] < 8.0
    assert content["commands"] == content["identical_commands"] > 300


@pytest.mark.smoke
def test_the_command_replays_whatever_threads_the_user_allows(tmp_path):
    """More BLAS threads would change the last bits: the executables decide for themselves."""
    directory = _demo(tmp_path, "--duration", "3", OMP_NUM_THREADS="2", OPENBLAS_NUM_THREADS="2")
    content = json.loads((directory / "summary.json").read_text())
    assert content["commands"] == content["identical_commands"] == 301
    for name in ("2_path", "3_states", "4_controls", "5_weights"):
        assert (directory / "figures" / f"figure_{name}.png").stat().st_size > 10_000
    page = (directory / "report.html").read_text(encoding="utf-8")
    assert "<title>Run report: demo on lissajous</title>" in page
    printed = (tmp_path / "printed").read_text(encoding="utf-8")
    assert "\nPathFollower repeats 301 of 301 commands exactly" in printed
    analysis = analyse_bag(directory / "bag", {}, 1, tmp_path / "trajectory.tum")
    assert {metric.name: content[metric.name] for metric in METRICS} == {
        name: value if np.isfinite(value) else None for name, value in analysis.metrics.items()
    }
