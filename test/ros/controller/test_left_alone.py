"""No robot is left driving: what the controller forgets, refuses, or cannot say, over real DDS."""

from __future__ import annotations

import subprocess
import sys

import pytest
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from adp_path_follower.ros.runtime.conversions import stamp_nanoseconds
from live_nodes import Drive, is_zero, running_script

pytestmark = pytest.mark.nodes


def change(peer, transition: int) -> bool:
    """Return whether the controller has made a lifecycle transition."""
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(peer.call(ChangeState, "path_follower/change_state", request).success)


def stands(drive: Drive, messages: int = 50) -> bool:
    """Return whether nothing but stops answers so many odometry messages."""
    drive.commands.clear()
    drive.peer.until_sent(messages)
    return all(map(is_zero, drive.commands))


def test_wrong_odometry_now_and_then_does_not_let_the_robot_go(drive):
    drive.odometry = None
    wrong = False

    def alternate() -> None:
        nonlocal wrong
        wrong = not wrong
        drive.peer.send_odometry((0.0, 0.1, 0.0), **({"x": float("nan")} if wrong else {}))

    timer = drive.peer.node.create_timer(0.02, alternate)
    drive.until_stopped()
    assert stands(drive)
    drive.peer.node.destroy_timer(timer)
    drive.odometry = {}
    drive.until_moving()


def test_a_robot_that_is_elsewhere_after_a_silence_waits_for_resume(drive):
    drive.odometry = None
    drive.until_stopped()
    drive.odometry = {"x": 50.0}
    drive.until_diagnosed("50.00 m from where it was")
    assert stands(drive)
    # The log says it, too, although the fault was there before, with another cause.
    drive.peer.until(lambda: "50.00 m from where it was" in drive.controller.output(), "the log")
    assert drive.peer.call(Trigger, "path_follower/resume").message == "following"
    drive.until_moving()


def test_no_command_is_made_of_odometry_older_than_the_timeout(peer, start):
    drive = Drive(peer, start)
    stamps = []
    sound = peer.odometry.publish

    def noted(message):
        stamps.append(stamp_nanoseconds(message.header))
        sound(message)

    peer.odometry.publish = noted
    drive.odometry = {"later": -0.4}
    peer.until_sent(15)
    drive.until_moving()
    drive.commands.clear()
    drive.odometry = None
    drive.until_stopped()
    moving = [stamp_nanoseconds(item.header) for item in drive.commands if not is_zero(item)]
    assert not moving or max(moving) - stamps[-1] <= 500_000_000


def test_a_speed_limit_that_cannot_hold_stops_the_robot_until_one_can(drive):
    limit = drive.peer.node.create_publisher(Float64, "speed_limit", 1)
    drive.peer.until_matched(limit)
    for value in (0.0, float("nan"), -1.0):
        limit.publish(Float64(data=value))
        drive.until_stopped()
        drive.until_diagnosed("speed limit rejected: setting 'speed_limit' is")
        assert stands(drive, messages=15)
        limit.publish(Float64(data=0.4))
        drive.until_moving()
    drive.until_moving()
    drive.until_commands(30)
    assert max(command.twist.linear.x for command in drive.commands) <= 0.4


def test_a_stop_outlasts_deactivation_and_cleanup(drive):
    assert drive.peer.call(Trigger, "path_follower/stop").success
    for transition in (
        Transition.TRANSITION_DEACTIVATE,
        Transition.TRANSITION_CLEANUP,
        Transition.TRANSITION_CONFIGURE,
        Transition.TRANSITION_ACTIVATE,
    ):
        assert change(drive.peer, transition)
    drive.peer.until_matched(drive.peer.odometry)
    assert stands(drive)
    drive.peer.call(Trigger, "path_follower/resume")
    drive.until_moving()


def test_after_a_deactivation_the_robot_starts_from_rest(peer, start):
    drive = Drive(peer, start, max_linear_accel=0.5, max_angular_accel=2.0)
    peer.until(lambda: drive.commands[-1].twist.linear.x > 0.2, "speed")
    seen = len(drive.commands)
    assert change(peer, Transition.TRANSITION_DEACTIVATE)
    assert change(peer, Transition.TRANSITION_ACTIVATE)
    peer.until(lambda: not is_zero(drive.commands[-1]) and is_zero(drive.commands[-9]), "a start")
    drive_on = drive.commands[seen:]
    last = max(index for index, command in enumerate(drive_on) if is_zero(command))
    # One period of the control timer, with as much again for one that is late.
    assert drive_on[last + 1].twist.linear.x <= 0.5 * 0.1 + 1e-9


def test_clients_cannot_end_the_controller(drive):
    peer = drive.peer
    assert not change(peer, Transition.TRANSITION_ACTIVATE)  # it is active
    assert not change(peer, 99)
    request = SetParameters.Request()
    request.parameters = [Parameter(name="target_gain", value=ParameterValue(type=77))] * 2
    results = peer.call(SetParameters, "path_follower/set_parameters", request).results
    assert [result.successful for result in results] == [False, False]
    assert "77" in results[0].reason
    drive.until_moving()
    assert "rejected: " in drive.controller.output()


def test_a_stop_of_an_inactive_controller_says_nothing(drive):
    assert change(drive.peer, Transition.TRANSITION_DEACTIVATE)
    drive.peer.until_quiet(drive.commands, 0.3)
    drive.commands.clear()
    assert drive.peer.call(Trigger, "path_follower/stop").success
    drive.peer.until_quiet(drive.commands, 0.3)
    assert not drive.commands


DEFECTIVE_TRANSITION = """
import sys
from adp_path_follower.ros.controller import path_process
from adp_path_follower.ros.controller.commands import Commands
from adp_path_follower.ros.controller.telemetry import Telemetry

def fail(*arguments):
    raise RuntimeError("a defect")

{owner}.{name} = fail
sys.exit(path_process.main())
"""


@pytest.mark.parametrize(
    ("owner", "name", "transition"),
    [("Commands", "activated", "on_activate"), ("Telemetry", "deliver_status", "on_deactivate")],
)
def test_a_transition_that_fails_stops_the_robot_and_ends_the_node(
    peer, domain, node_server, tmp_path, owner, name, transition
):
    commands = peer.listen(TwistStamped, "cmd_vel")
    log = tmp_path / "defective.log"
    with running_script(
        node_server, DEFECTIVE_TRANSITION.format(owner=owner, name=name), domain, log
    ) as node:
        if transition == "on_deactivate":
            peer.until_matched(peer.odometry, peer.path)
            peer.send_path()
            peer.node.create_timer(0.02, lambda: peer.send_odometry((0.0, 0.1, 0.0)))
            peer.until(lambda: commands and not is_zero(commands[-1]), "motion")
            assert not change(peer, Transition.TRANSITION_DEACTIVATE)
        peer.until(lambda: node.poll() is not None, "the end of the node")
    peer.until(lambda: all(map(is_zero, commands[-3:])), "zero velocity, if any was told before")
    assert node.returncode == 1
    assert f"{transition} failed, stopping: RuntimeError: a defect" in log.read_text()
    assert "Traceback" not in log.read_text()


TALKATIVE = """
import rclpy
from rclpy.logging import get_logger
from adp_path_follower.ros.runtime.log_output import unblocked_stderr

with unblocked_stderr():
    rclpy.init()
    for number in range({count}):
        get_logger("talker").error(f"line {{number}} " + {width} * "-")
"""


def test_a_log_that_nobody_reads_holds_nothing_up():
    # Four times what the pipes hold, as from a terminal after Ctrl-S.
    with subprocess.Popen(
        [sys.executable, "-c", TALKATIVE.format(count=1000, width=5000)], stderr=subprocess.PIPE
    ) as process:
        assert process.wait(60.0) == 0


def test_a_log_that_is_read_is_complete():
    script = [sys.executable, "-c", TALKATIVE.format(count=1000, width=100)]
    text = subprocess.run(script, capture_output=True, text=True, check=True).stderr
    lines = [line.split("line ")[1].split()[0] for line in text.splitlines()]
    assert lines == [str(number) for number in range(1000)]
