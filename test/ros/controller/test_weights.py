"""`~/save_weights` and `weights_file` with real nodes, and recordings of such runs."""

from __future__ import annotations

import dataclasses
import os

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from std_srvs.srv import Trigger

from adp_path_follower.bags.reader import read_run
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.learning.weights_file import encode, read_weights
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build, update
from adp_path_follower.study.replay.replay import compare_weights, replay
from adp_path_follower.study.replay.write_bag import write_replay
from live_nodes import Drive, Peer, running_script

pytestmark = pytest.mark.nodes

PERIOD = 0.02  # [s]


class Stepwise:
    """A controller that answers each odometry message of the test with one command."""

    def __init__(self, peer: Peer, start, begin: int, **parameters) -> None:
        """Start the controller; the first odometry has the stamp `begin` [s]."""
        self.peer, self.time = peer, round(begin / PERIOD)
        self.commands = peer.listen(TwistStamped, "cmd_vel")
        self.node = start("controller", control_trigger="odometry", use_sim_time=True, **parameters)
        peer.until_matched(peer.odometry, peer.path)
        peer.send_path("circle:0.7")
        peer.until(lambda: "new path" in self.node.output(), "the path")

    def answer(self, pose: tuple[float, float, float]) -> tuple[float, float]:
        """Return v, w that answer a pose, one period after the last."""
        self.time += 1
        stamp = round(1e9 * self.time * PERIOD)
        self.peer.send_odometry(pose, stamp=1e-9 * stamp)

        def answers():
            return [
                command.twist
                for command in self.commands
                if 10**9 * command.header.stamp.sec + command.header.stamp.nanosec == stamp
            ]

        self.peer.until(answers, "an answer")
        return answers()[-1].linear.x, answers()[-1].angular.z


@pytest.mark.parametrize("scheduling", ["arc_length", "path_state"])
def test_the_next_run_commands_what_this_one_would_have(peer, start, tmp_path, scheduling):
    file = tmp_path / "weights.npz"
    settings = {"scheduling": scheduling, "basis_degree": 4, "save_weights_to": str(file)}
    first = Stepwise(peer, start, 1000, **settings)
    for _ in range(100):
        first.answer((0.1, 0.1, 0.2))
    saved = peer.call(Trigger, "path_follower/save_weights")
    assert saved.success, saved.message
    assert str(file) in saved.message
    assert peer.call(Trigger, "path_follower/resume").success  # begins anew, as a new run does
    poses = [(0.3, 0.05, 0.1), (0.31, 0.06, 0.12), (0.32, 0.06, 0.14)]
    expected = [first.answer(pose) for pose in poses]
    assert first.node.stop() == 0

    cold = Stepwise(peer, start, 2000, **settings)
    assert [cold.answer(pose) for pose in poses] != expected
    assert cold.node.stop() == 0

    second = Stepwise(peer, start, 3000, **settings, weights_file=str(file))
    assert [second.answer(pose) for pose in poses] == expected
    assert f"weights to start from: {file}" in second.node.output()
    assert "not used" not in second.node.output()


def test_saving_while_driving(peer, start, tmp_path):
    drive = Drive(peer, start, save_weights_to=str(tmp_path / "none" / "weights.npz"))
    answer = peer.call(Trigger, "path_follower/save_weights")
    assert not answer.success
    assert "cannot be written: No such file or directory; set 'save_weights_to'" in answer.message
    file = tmp_path / "weights.npz"
    assert peer.set_parameter("path_follower", "save_weights_to", str(file)).successful
    for _ in range(3):
        assert peer.call(Trigger, "path_follower/save_weights").success
    read_weights(file, build(Settings, {}))
    assert [entry.name for entry in tmp_path.glob("*weights*")] == ["weights.npz"]
    drive.until_moving()


SAVE = "path_follower/save_weights"
SLOW_DISK = """
import sys
from adp_path_follower.ros.controller import weights
from adp_path_follower.ros.controller import path_process

write = weights.write_weights


def late(file, content):
    print("writing", flush=True)
    open({gate!r}).read()
    write(file, content)


weights.write_weights = late
sys.argv[1:] = ["--ros-args", "-p", "save_weights_to:={file}"]
sys.exit(path_process.main())
"""


class SlowDisk:
    """A controller that drives, and has asked a disk to write that does not before `go_on`."""

    def __init__(self, peer: Peer, process, log, gate) -> None:
        peer.call(Trigger, SAVE)  # there is nothing to save yet
        self.drive = Drive(peer, lambda executable: process)
        self._gate = gate
        self.saved = peer.ask(SAVE, Trigger.Request())
        peer.until(lambda: "writing" in log.read_text(), "the slow disk")

    def go_on(self) -> None:
        """Let the disk write."""
        self._gate.write_text("go on")
        self.drive.peer.until(self.saved.done, "the answer")


@pytest.fixture
def slow_disk(peer, domain, node_server, tmp_path):
    gate, log = tmp_path / "gate", tmp_path / "controller.log"
    os.mkfifo(gate)
    text = SLOW_DISK.format(gate=str(gate), file=tmp_path / "weights.npz")
    with running_script(node_server, text, domain, log) as process:
        yield SlowDisk(peer, process, log, gate)
        process.terminate()
        assert process.wait(30.0) == 0
    assert "Traceback" not in log.read_text()


def test_a_slow_disk_delays_neither_commands_nor_a_stop(slow_disk, peer, tmp_path):
    assert "still being written" in peer.call(Trigger, SAVE).message
    slow_disk.drive.until_moving()
    assert peer.call(Trigger, "path_follower/stop").success
    slow_disk.drive.until_stopped()
    assert not slow_disk.saved.done()
    slow_disk.go_on()
    assert slow_disk.saved.result().success
    read_weights(tmp_path / "weights.npz", build(Settings, {}))


def test_a_node_that_is_cleaned_up_meanwhile_answers_all_the_same(slow_disk, peer):
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert peer.call(ChangeState, "path_follower/change_state", request).success
    slow_disk.go_on()
    assert slow_disk.saved.result().success
    assert "nothing was learned yet" in peer.call(Trigger, SAVE).message


def test_a_home_that_nobody_has_is_refused_in_one_sentence(peer, start):
    drive = Drive(peer, start, save_weights_to="~nobody_has_this_name/weights.npz")
    answer = peer.call(Trigger, SAVE)
    assert not answer.success
    assert "'~nobody_has_this_name' is nobody's home" in answer.message
    drive.until_moving()


def test_nothing_to_save_before_the_first_step(peer, start):
    start("controller")
    answer = peer.call(Trigger, "path_follower/save_weights")
    assert not answer.success
    assert "nothing was learned yet" in answer.message


@pytest.fixture
def weights(tmp_path):
    """Return a weights file for the default settings along the circle."""
    from adp_path_follower.core.driving.driver import Driver
    from adp_path_follower.core.path.library import named_path

    driver = Driver(build(Settings, {}))
    driver.follow(named_path("circle:0.7"))
    for step in range(100):
        driver.step(np.array([0.1, 0.1, 0.2]), step * 20_000_000)
    file = tmp_path / "weights.npz"
    file.write_bytes(encode(driver.follower.saved_weights()))
    return file


@pytest.mark.parametrize(
    ("damage", "parameters", "told"),
    [
        (lambda file: None, {"desired_speed": 0.3}, "belongs to other settings: learned with"),
        (lambda file: file.unlink(), {}, "cannot be read: No such file"),
        (lambda file: file.write_bytes(b"x" * 99), {}, "is no weights file, or is damaged"),
    ],
)
def test_a_file_that_does_not_fit_is_refused_at_the_start(start, weights, damage, parameters, told):
    damage(weights)
    node = start("controller", weights_file=str(weights), **parameters)
    assert node.process.wait(30.0) == 2
    sentences = [line for line in node.output().splitlines() if "[FATAL]" in line]
    assert len(sentences) == 1
    assert f"weights file {weights} {told}" in sentences[0]


@pytest.mark.parametrize(
    ("executable", "parameter"),
    [("controller", "weights_file"), ("recorder", "output"), ("path_publisher", "path")],
)
def test_a_file_below_nobodys_home_is_refused_at_the_start(start, executable, parameter):
    node = start(executable, **{parameter: "~nobody_has_this_name/file.csv"})
    assert node.process.wait(30.0) == 2
    (sentence,) = node.output().splitlines()
    assert "'~nobody_has_this_name' is nobody's home" in sentence


def test_another_path_starts_from_the_riccati_solution_with_a_warning(peer, start, weights):
    drive = Drive(peer, start, weights_file=str(weights))  # along a line
    warnings = [line for line in drive.controller.output().splitlines() if "[WARN]" in line]
    assert len(warnings) == 1
    assert "the weights of 'weights_file' are not used on this path: they were" in warnings[0]


def test_a_recording_of_a_warm_start_replays_to_the_last_bit(peer, start, weights, tmp_path):
    recorder = start("recorder", output=str(tmp_path / "bag"))
    controller = start("controller", weights_file=str(weights))
    start("sim_unicycle", x=0.1, y=0.2)
    start("path_publisher", path="circle:0.7")
    commands = peer.listen(TwistStamped, "cmd_vel")
    heard = ("cmd_vel", "path", "path_follower/initial_weights", "path_follower/measured_pose")
    peer.until(
        lambda: all(f"recording /{topic}\n" in recorder.output() for topic in heard),
        "the recorder",
    )
    peer.until(lambda: any(command.twist.linear.x > 0.1 for command in commands), "commands")
    count = len(commands)
    peer.until(lambda: len(commands) > count + 100, "a hundred commands")
    for node in (controller, recorder):
        node.stop()
    bag = tmp_path / "bag"
    run = read_run(bag)
    assert run.initial_weights == weights.read_bytes()
    found = replay(run)
    assert found.answered.sum() > 100
    assert found.identical[found.answered].all()
    weights_found = compare_weights(run, found)
    assert not weights_found.notes
    assert len(weights_found.identical) > 100
    assert weights_found.identical.all()
    with pytest.raises(FileError, match="lacks the weights that the controller started from"):
        replay(dataclasses.replace(run, initial_weights=b""))
    with pytest.raises(FileError, match="is no weights file, or is damaged"):
        replay(dataclasses.replace(run, initial_weights=b"x"))
    # With a slower learner it is another run, which is written and replays as such.
    other = replay(run, update(found.follower.settings, {"actor_gain": 1.0}))
    assert not other.identical.all()
    write_replay(other, bag, run.topics, tmp_path / "again")
    again = read_run(tmp_path / "again")
    assert replay(again).identical.all()
    assert not replay(dataclasses.replace(again, configurations=run.configurations)).identical.all()
