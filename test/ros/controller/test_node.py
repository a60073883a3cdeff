"""The controller node over real DDS: what it refuses, and that the robot is told to stop."""

from __future__ import annotations

import math
import re
import signal
from pathlib import Path as FilePath

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Path as PathMessage
from std_srvs.srv import Trigger

from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import setting_fields
from adp_path_follower.ros.runtime.parameters import descriptor
from adp_path_follower.study.demo import NodeProcess
from live_nodes import TIMEOUT, Drive, Peer, ends_with_stop, is_zero, running_script

pytestmark = pytest.mark.nodes


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({"desired_sped": 0.5}, "unknown setting 'desired_sped'; did you mean 'desired_speed'?"),
        ({"desired_speed": "fast"}, "setting 'desired_speed' is 'fast', but must be a number"),
        ({"desired_speed": -1.0}, "setting 'desired_speed' is -1.0, but must be a number, above 0"),
        ({"input_cost": (1.0, -1.0)}, "setting 'input_cost' is [1.0, -1.0], but must be positive"),
        (
            {"initial_weights": "listed", "initial_critic_weights": (1.0, 2.0)},
            "has 2 values, but the basis 'polynomial' needs 80",
        ),
        ({"basis": "cubic"}, "setting 'basis' is 'cubic', but must be one of paper"),
    ],
)
def test_refuses_to_start_with_bad_settings(start, parameters, expected):
    node = start("controller", **parameters)
    assert node.process.wait(30.0) == 2
    sentences = [line for line in node.output().splitlines() if "[FATAL]" in line]
    assert len(sentences) == 1
    assert expected in sentences[0]


def test_refuses_a_parameter_file_that_is_none(start, tmp_path):
    file = tmp_path / "broken.yaml"
    file.write_text("path_follower: [")
    node = start("controller", "--params-file", str(file))
    assert node.process.wait(30.0) == 2
    assert "broken.yaml" in node.output()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_says_stop_three_times_before_it_goes(drive, number):
    seen = len(drive.commands)
    assert drive.controller.stop(number) == 0
    drive.peer.until(lambda: ends_with_stop(drive.commands[seen:]), "the last words")


def _takes_signals(process_id: int) -> bool:
    """Return whether a process has a handler for SIGTERM: Python itself has none."""
    status = FilePath(f"/proc/{process_id}/status").read_text()
    caught = int(re.search(r"^SigCgt:\s*(\w+)$", status, re.M).group(1), 16)
    return bool(caught >> (signal.SIGTERM - 1) & 1)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("delay", [0.0, 0.2, 0.5])
def test_a_signal_while_starting_leaves_no_traceback(domain, peer, tmp_path, number, delay):
    # Before that, while Python starts itself, no program has a say in what is printed.
    node = NodeProcess("controller", {}, log=tmp_path / "controller.log", domain=domain)
    peer.until(lambda: _takes_signals(node.process.pid), "the handlers")
    peer.pause(delay)
    node.stop(number, timeout=TIMEOUT)
    assert "Traceback" not in node.output()


def test_starts_with_zero_velocity(peer, start):
    commands = peer.listen(TwistStamped, "cmd_vel")
    start("controller")
    peer.until(lambda: len(commands) >= 3, "zero velocities at the start")
    assert all(map(is_zero, commands))
    peer.until_quiet(commands)  # then it leaves the robot to others
    assert all(map(is_zero, commands))


def test_commands_come_at_the_set_rate(peer, start):
    drive = Drive(peer, start, controller_frequency=50.0)
    drive.commands.clear()
    peer.until(lambda: len(drive.commands) > 100, "a hundred commands")
    headers = [command.header for command in drive.commands]
    stamps = [header.stamp.sec + 1e-9 * header.stamp.nanosec for header in headers]
    # The timer follows the clock: a tick that a busy machine delays is not repeated.
    assert np.median(np.diff(stamps)) == pytest.approx(0.02, rel=0.1)


def test_plain_twist_where_it_is_asked_for(peer, start):
    commands = peer.listen(Twist, "cmd_vel")
    start("controller", enable_stamped_cmd_vel=False)
    peer.until_matched(peer.odometry, peer.path)
    peer.send_path()
    peer.node.create_timer(0.02, lambda: peer.send_odometry((0.0, 0.1, 0.0)))
    peer.until(lambda: any(command.linear.x > 0.1 for command in commands), "a Twist to move")


@pytest.mark.parametrize(
    ("broken", "cause"),
    [
        ({"x": math.nan}, "odometry is not finite"),
        ({"y": math.inf}, "odometry is not finite"),
        ({"qz": math.nan}, "orientation is not finite"),
        ({"qw": 0.0, "qz": 0.0}, "quaternion of zero norm"),
        (None, "no odometry for more than 0.5 s"),
    ],
)
def test_bad_odometry_stops_the_robot_until_it_is_good_again(drive, broken, cause):
    drive.odometry = broken
    drive.until_stopped()
    drive.until_diagnosed(cause)
    drive.odometry = {}
    drive.until_moving()


def _broken_path(kind: str) -> PathMessage:
    from adp_path_follower.core.path.library import named_path
    from adp_path_follower.ros.runtime.conversions import poses_message

    message = poses_message(named_path("circle:1.0").points(0.1), "odom", 0)
    if kind == "one point":
        message.poses = message.poses[:1]
    elif kind == "NaN":
        message.poses[3].pose.position.x = math.nan
    elif kind == "frame":
        message.header.frame_id = "map"
    return message


@pytest.mark.parametrize(
    ("kind", "cause"),
    [
        ("one point", "path has 1 distinct points, but needs at least 2"),
        ("NaN", "path point 3 is"),
        ("frame", "path is in frame 'map', but odometry in 'odom'"),
    ],
)
def test_a_bad_path_is_refused_and_the_present_one_goes_on(drive, kind, cause):
    drive.peer.path.publish(_broken_path(kind))
    drive.until_diagnosed(cause)
    drive.until_moving()
    assert f"path rejected: {cause}" in drive.controller.output()
    drive.peer.send_path("circle:0.5")
    drive.peer.until(lambda: "new path: closed" in drive.controller.output(), "the next good path")
    drive.until_moving()


def test_path_in_another_frame_waits_when_odometry_comes_later(peer, start):
    node = start("controller")
    peer.until_matched(peer.odometry, peer.path)
    peer.send_path(frame="map")
    peer.until(lambda: "new path" in node.output(), "the path")
    peer.node.create_timer(0.02, lambda: peer.send_odometry((0.0, 0.0, 0.0)))
    peer.until(lambda: "path is in frame 'map'" in node.output(), "the cause")


def test_parameters_change_while_driving_or_are_refused(drive):
    peer = drive.peer
    for name, value, reason in (
        ("desired_speed", -1.0, "desired_speed"),
        ("input_cost", [1.0, 0.0], "positive definite"),
        ("sample_half_widths", [1.0, 1.0, 1.0, 1.0], "below 1"),
        ("controller_frequency", 20.0, "read-only"),
        ("basis", "paper_misprinted", "read-only"),
    ):
        result = peer.set_parameter("path_follower", name, value)
        assert not result.successful
        assert reason in result.reason
    drive.until_moving()
    assert peer.set_parameter("path_follower", "max_linear_vel", 0.25).successful
    peer.until(lambda: drive.commands[-1].twist.linear.x <= 0.25, "a slower robot")
    drive.commands.clear()
    drive.until_moving()
    assert max(command.twist.linear.x for command in drive.commands) <= 0.25
    # An integer where a number is meant is no reason to refuse.
    assert peer.set_parameter("path_follower", "max_linear_vel", 1).successful


def test_learning_that_goes_wrong_is_told_and_the_robot_drives_on(peer, start):
    drive = Drive(peer, start, actor_weight_bound=0.5)  # smaller than any useful weights
    drive.until_diagnosed("Riccati policy instead of the learned one", level=b"\x01")
    assert "learning has gone wrong: the critic's weights have norm" in drive.controller.output()
    drive.until_moving()
    assert peer.set_parameter("path_follower", "actor_weight_bound", 1000.0).successful
    peer.until(lambda: "learning succeeds again" in drive.controller.output(), "the recovery")
    drive.until_moving()


def test_reset_learning_answers(drive):
    answer = drive.peer.call(Trigger, "path_follower/reset_learning")
    assert answer.success
    drive.until_moving()


def _change(peer: Peer, transition: int) -> bool:
    request = ChangeState.Request()
    request.transition.id = transition
    return peer.call(ChangeState, "path_follower/change_state", request).success


def _state(peer: Peer) -> str:
    return peer.call(GetState, "path_follower/get_state").current_state.label


def test_lifecycle_without_autostart(peer, start):
    commands = peer.listen(TwistStamped, "cmd_vel")
    node = start("controller", autostart=False)
    assert _state(peer) == "unconfigured"
    assert _change(peer, Transition.TRANSITION_CONFIGURE)
    peer.until_matched(peer.odometry, peer.path)
    peer.send_path()
    peer.node.create_timer(0.02, lambda: peer.send_odometry((0.0, 0.1, 0.0)))
    peer.until(lambda: "new path" in node.output(), "the path")
    peer.until_sent(25)
    assert _state(peer) == "inactive"
    assert not commands
    assert _change(peer, Transition.TRANSITION_ACTIVATE)
    peer.until(lambda: any(not is_zero(command) for command in commands), "commands to move")
    assert _change(peer, Transition.TRANSITION_DEACTIVATE)
    peer.until_quiet(commands)  # inactive: not a word
    assert ends_with_stop(commands)
    assert _change(peer, Transition.TRANSITION_CLEANUP)
    assert _change(peer, Transition.TRANSITION_CONFIGURE)
    assert _change(peer, Transition.TRANSITION_ACTIVATE)
    commands.clear()
    # The path is latched, so it arrives again, and the robot moves again.
    peer.until(lambda: any(not is_zero(command) for command in commands), "commands to move")
    assert _change(peer, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert node.process.wait(30.0) == 0
    peer.until(lambda: ends_with_stop(commands), "the last words")


@pytest.mark.parametrize("stamped", [True, False])
def test_the_end_of_an_open_path_is_a_goal(peer, start, tmp_path, stamped):
    file = tmp_path / "short.csv"
    file.write_text("x,y\n0,0\n0.3,0\n0.6,0\n")
    commands = peer.listen(TwistStamped if stamped else Twist, "cmd_vel")
    node = start("controller", enable_stamped_cmd_vel=stamped)
    start("sim_unicycle")
    start("path_publisher", path=str(file))
    peer.until(lambda: "goal reached" in node.output(), "the goal")

    def at_rest() -> bool:
        last = [command.twist if stamped else command for command in commands[-3:]]
        return all(twist.linear.x == twist.angular.z == 0.0 for twist in last)

    peer.until(at_rest, "zero velocity")


def test_descriptors_come_from_the_settings():
    for field in setting_fields(Settings):
        described = descriptor(field)
        assert field.spec.doc in described.description
        assert described.read_only == bool(field.spec.read_only)
        if field.kind is float and field.spec.high < math.inf:
            assert described.floating_point_range[0].to_value == field.spec.high


BROKEN_CONTROLLER = """
import sys
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.ros.controller import path_process

step_at, steps = PathFollower.step_at, []

def failing(self, pose, time, learn=True):
    steps.append(time)
    if len(steps) > 50:
        raise RuntimeError("a defect")
    return step_at(self, pose, time, learn)

PathFollower.step_at = failing
sys.exit(path_process.main())
"""


def test_an_exception_in_a_callback_stops_the_robot_first(peer, domain, node_server, tmp_path):
    commands = peer.listen(TwistStamped, "cmd_vel")
    log = tmp_path / "broken.log"
    with running_script(node_server, BROKEN_CONTROLLER, domain, log) as process:
        peer.until_matched(peer.odometry, peer.path)
        peer.send_path()
        peer.node.create_timer(0.02, lambda: peer.send_odometry((0.0, 0.1, 0.0)))
        peer.until(lambda: process.poll() is not None, "the end of the node")
    peer.until(lambda: ends_with_stop(commands), "zero velocity")
    text = log.read_text()
    assert process.returncode == 1
    assert "unexpected error, stopping: RuntimeError: a defect" in text
    assert "Traceback" not in text
    assert any(not is_zero(command) for command in commands)
