"""Faults stop the robot, over real DDS with real processes, and it resumes after them."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from adp_path_follower.bags.reader import read_run
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.registry import load_plugins
from adp_path_follower.core.settings.groups import ControllerSettings, Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.messages.configuration import parse_configuration
from adp_path_follower.ros.controller.commands import Commands
from adp_path_follower.study.demo import run_closed_loop
from adp_path_follower.study.replay.replay import compare_weights, replay
from live_nodes import Drive, Peer, ends_with_stop, is_zero, running_script

pytestmark = pytest.mark.nodes


def silent_after_stop(drive: Drive) -> bool:
    """Return whether the robot is told to stop, and then left to others."""
    drive.until_stopped()
    drive.peer.until_quiet(drive.commands)
    return ends_with_stop(drive.commands)


@pytest.mark.parametrize(
    ("broken", "cause"),
    [
        ({"later": -1.0}, "old by its stamp: are the clocks synchronised?"),
        ({"later": 3600.0}, "ahead by its stamp: are the clocks synchronised?"),
        ({"v": 50.0}, "odometry says 50 m/s, but max_linear_vel is 1"),
        ({"frame_id": ""}, "odometry has no frame: set header.frame_id"),
        ({"child_frame_id": "other"}, "odometry is of 'other' now, and was of 'base_link'"),
    ],
)
def test_odometry_that_stays_wrong_stops_the_robot_until_it_is_right(drive, broken, cause):
    drive.odometry = broken
    assert silent_after_stop(drive)
    drive.until_diagnosed(cause)
    drive.odometry = {}
    drive.until_moving()


@pytest.mark.parametrize(
    ("broken", "cause"),
    [
        ({"x": 3.0}, "odometry jumped by 3.00 m"),
        ({"qz": 1.0, "qw": 0.0}, "odometry turned by"),
        ({"back": 0.1}, "odometry stamps went back by"),
    ],
)
def test_one_message_that_cannot_be_is_a_stop_and_the_robot_goes_on(drive, broken, cause):
    seen = len(drive.commands)
    drive.odometry = None
    drive.peer.send_odometry((0.0, 0.1, 0.0), **broken)
    drive.until_diagnosed(cause)
    drive.peer.until(lambda: any(map(is_zero, drive.commands[seen:])), "a stop")
    drive.odometry = {}
    drive.until_moving()


def test_stop_and_resume(drive):
    assert drive.peer.call(Trigger, "path_follower/stop").success
    assert silent_after_stop(drive)
    drive.until_diagnosed("stopped: ~/stop was called", level=b"\x01")
    answer = drive.peer.call(Trigger, "path_follower/resume")
    assert (answer.success, answer.message) == (True, "following")
    drive.until_moving()


def test_an_empty_path_stops_and_the_next_one_goes_on(drive):
    drive.peer.path.publish(PathMessage(header=Header(frame_id="odom")))
    assert silent_after_stop(drive)
    drive.until_diagnosed("waiting: no path", level=b"\x01")
    drive.peer.send_path()
    drive.until_moving()


def test_too_far_from_the_path_is_a_stop_until_resume(drive):
    peer = drive.peer
    assert peer.set_parameter("path_follower", "max_cross_track_error", 0.05).successful
    assert silent_after_stop(drive)
    drive.until_diagnosed("above max_cross_track_error 0.05")
    # Still too far: it stops again.
    drive.commands.clear()
    peer.call(Trigger, "path_follower/resume")
    assert silent_after_stop(drive)
    drive.odometry = {"y": 0.02}
    peer.until_sent(25)
    assert silent_after_stop(drive)
    peer.call(Trigger, "path_follower/resume")
    drive.until_moving()


def stamp(command: TwistStamped) -> float:
    """Return the stamp of a command [s]."""
    return command.header.stamp.sec + 1e-9 * command.header.stamp.nanosec


class SimulatedTime:
    """A clock of the test, and odometry by it."""

    def __init__(self, peer: Peer) -> None:
        self.publisher = peer.node.create_publisher(Clock, "/clock", 10)
        self.time, self.runs, self.odometry, self._peer = 5.0, True, True, peer
        peer.node.create_timer(0.01, self._tick)

    def _tick(self) -> None:
        if self.runs:
            self.time += 0.01
            message = Clock()
            message.clock.sec = int(self.time)
            message.clock.nanosec = int(1e9 * (self.time % 1.0))
            self.publisher.publish(message)
        if self.odometry:
            self._peer.send_odometry((0.0, 0.1, 0.0), stamp=self.time)

    @contextmanager
    def set_to(self, time: float) -> Iterator[None]:
        """Set the clock back and send no odometry meanwhile: by either time some would be wrong."""
        self.odometry, last = False, self.time
        commands = self._peer.received["cmd_vel"]
        # A command that is later has seen the last odometry.
        self._peer.until(lambda: stamp(commands[-1]) > last + 0.1, "a later command")
        self.time = time
        yield
        self.odometry = True


def test_a_clock_that_does_not_start_stands_still_or_jumps_back(peer, start):
    commands = peer.listen(TwistStamped, "cmd_vel")
    # The timeout is longer than setting the clock back takes, so that silence is not the fault.
    node = start("controller", use_sim_time=True, odom_timeout=2.0)
    peer.until(lambda: "waiting: no time on /clock" in node.output(), "the wait for the clock")
    peer.send_path()
    clock = SimulatedTime(peer)

    def until_moving() -> None:
        commands.clear()
        peer.until(lambda: commands and not is_zero(commands[-1]), "motion")

    def until_stopped(cause: str) -> None:
        peer.until(lambda: cause in node.output(), cause)
        peer.until(lambda: is_zero(commands[-1]), "zero velocity")

    until_moving()
    clock.runs = False
    until_stopped("no control step for more than 2 s")
    clock.runs = True
    until_moving()
    with clock.set_to(2.0):
        until_stopped("the clock went back")
    until_moving()


HANGING_CONTROLLER = """
import os, sys
from adp_path_follower.ros.controller import path_process
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.ros.runtime.path_frame import PathFrame
from adp_path_follower.ros.controller.telemetry import Telemetry

OWNER, NAME = {owner}, "{name}"
works = getattr(OWNER, NAME)

def hanging(*arguments, **named):
    if os.path.exists({gate!r}):
        open({gate!r}).read()
    return works(*arguments, **named)

setattr(OWNER, NAME, hanging)
sys.exit(path_process.main())
"""


@pytest.mark.parametrize(
    ("owner", "name"),
    [("PathFollower", "step_at"), ("PathFrame", "odometry_in"), ("Telemetry", "step")],
)
def test_a_node_that_hangs_does_not_keep_the_robot_going_and_replays(
    peer, start, domain, node_server, tmp_path, owner, name
):
    commands = peer.listen(TwistStamped, "cmd_vel")
    gate, log = tmp_path / "gate", tmp_path / "hanging.log"
    text = HANGING_CONTROLLER.format(owner=owner, name=name, gate=str(gate))
    recorder = start("recorder", output=str(tmp_path / "bag"))
    with running_script(node_server, text, domain, log):
        peer.until_matched(peer.odometry, peer.path)
        peer.until_recorded()
        peer.send_path()
        peer.node.create_timer(0.02, lambda: peer.send_odometry((0.0, 0.1, 0.0)))
        peer.until(lambda: commands and not is_zero(commands[-1]), "motion")
        os.mkfifo(gate)
        peer.until(lambda: is_zero(commands[-1]), "zero velocity while it hangs")
        assert "fault: " not in log.read_text()  # it hangs still, and cannot say so
        with gate.open("w"):
            gate.unlink()  # and it goes on
        # It has had no odometry or sent no command, or the first it hears of is old by its stamp.
        peer.until(lambda: "fault: " in log.read_text(), "its end")
        commands.clear()
        peer.until(lambda: len(commands) > 20 and not is_zero(commands[-1]), "motion again")
    recorder.stop()
    again = replay(read_run(tmp_path / "bag"))  # the step of a command that came too late, too
    assert again.identical[again.answered].all()


FALTERING_POLICY = """
import numpy as np
import adp_path_follower as adp

class Faltering:
    def __init__(self, settings):
        self.calls = 0

    def modified_input(self, zeta, curvature, feedforward):
        self.calls += 1
        wanted = np.stack([0.5 + 0.0 * zeta[..., 0], -zeta[..., 1] - 2.0 * zeta[..., 2]], axis=-1)
        return (np.nan if self.calls in (40, 90) else 1.0) * wanted - feedforward

adp.register_far_policy("faltering", Faltering)
"""


def test_a_command_that_is_no_number_resets_learning_and_replays(tmp_path, monkeypatch):
    plugin = tmp_path / "faltering_policy.py"
    plugin.write_text(FALTERING_POLICY)
    monkeypatch.setenv("ADP_PLUGINS", str(plugin))
    load_plugins()
    settings = build(Settings, {"wide_region": "faltering"})
    line, start = named_path("line"), np.array([0.0, 2.0, 0.0])
    run_closed_loop(settings, line, "line", start, 6.0, tmp_path, lambda progress: None)
    run = read_run(tmp_path / "bag")
    assert parse_configuration(run.configuration).counts.learning_resets == 2
    again = replay(run)
    assert again.answered.sum() > 500
    assert again.identical[again.answered].all()
    assert (again.recorded == 0.0).all(axis=1).sum() == 2
    assert compare_weights(run, again).identical.all()


def test_steps_that_the_settings_forbid_are_in_the_record(peer, start, tmp_path):
    recorder = start("recorder", output=str(tmp_path / "bag"))
    too_far = {"path_start": "arc_length", "start_arc_length": 1000.0}
    node = start("controller", robot_model="learned", **too_far)
    peer.until_matched(peer.odometry, peer.path)
    peer.until_recorded()
    commands = peer.listen(TwistStamped, "cmd_vel")
    peer.send_path()
    peer.node.create_timer(0.02, lambda: peer.send_odometry((0.3, 0.1, 0.0), v=0.1))
    peer.until(lambda: "setting 'start_arc_length' is 1000" in node.output(), "the sentence")
    assert peer.set_parameter("path_follower", "start_arc_length", 0.2).successful
    peer.until(lambda: len(commands) > 50 and not is_zero(commands[-1]), "motion")
    recorder.stop()
    run = read_run(tmp_path / "bag")
    again = replay(run)
    assert 0 < len(again.steps.stamp) < len(run.series["measured_pose"].stamp)
    assert again.answered.sum() > 40
    assert again.identical[again.answered].all()
    with pytest.raises(SettingsError, match="'start_arc_length' is 1000"):
        replay(run, overlay={"start_arc_length": 1000.0})


def test_a_stop_is_said_ten_times_however_long_that_was_kept_waiting(peer):
    heard = peer.listen(TwistStamped, "cmd_vel")
    node = rclpy.create_node("path_follower", context=peer.context)
    commands = Commands(node, ControllerSettings)
    peer.until(lambda: node.count_subscribers("cmd_vel"), "the listener")
    peer.until(lambda: commands.repeat_stop() or heard, "the first words to it")
    peer.until_quiet(heard, 0.2)
    heard.clear()
    commands.stop()
    time.sleep(0.7)  # longer than a stop is repeated
    for _ in range(30):
        commands.repeat_stop()
    peer.until(lambda: len(heard) >= 11, "ten repetitions")
    peer.until_quiet(heard, 0.3)
    assert len(heard) == 11
    assert all(map(is_zero, heard))
    commands.destroy()
    node.destroy_node()


def test_status_is_known_at_once_to_those_who_come_late(drive):
    latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    found = drive.peer.listen(DiagnosticStatus, "path_follower/status", latched)

    def last() -> dict[str, str]:
        return {item.key: item.value for item in found[-1].values} if found else {}

    drive.peer.until(lambda: found, "the status")
    assert (found[0].level, found[0].message) == (b"\x00", "following")
    assert found[0].name == "/path_follower"
    drive.peer.call(Trigger, "path_follower/stop")
    drive.peer.until(lambda: last()["state"] == "stopped", "the stop")
    assert last()["cause"] == "~/stop was called"
    assert last()["remedy"] == "call ~/resume"
    now = 1e-9 * drive.peer.node.get_clock().now().nanoseconds
    assert now - 30.0 < float(last()["since [s]"]) <= now
    count, diagnosed = len(found), len(drive.diagnostics)
    drive.peer.until(lambda: len(drive.diagnostics) > diagnosed + 1, "/diagnostics, twice")
    assert len(found) == count
    drive.controller.stop()
    drive.peer.until(lambda: last()["state"] == "inactive", "the last words")


def test_odometry_in_another_frame_stops_the_robot_until_a_path_comes_in_it(drive):
    drive.odometry = {"frame_id": "map"}
    assert silent_after_stop(drive)
    drive.until_diagnosed("path is in frame 'odom', but odometry in 'map'", level=b"\x01")
    drive.peer.send_path(frame="map")
    drive.until_moving()


def test_turned_too_far_from_the_path_is_a_stop_until_resume(drive):
    assert drive.peer.set_parameter("path_follower", "max_heading_error", 0.3).successful
    drive.odometry = {"qz": 0.2474, "qw": 0.9689}  # half a radian
    assert silent_after_stop(drive)
    drive.until_diagnosed("above max_heading_error 0.3")
    drive.odometry = {}
    drive.peer.until_sent(15)
    drive.peer.call(Trigger, "path_follower/resume")
    drive.until_moving()


@pytest.mark.parametrize(
    "transition", [Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVE_SHUTDOWN]
)
def test_a_lifecycle_transition_stops_the_robot_first(drive, transition):
    seen = len(drive.commands)
    request = ChangeState.Request(transition=Transition(id=transition))
    assert drive.peer.call(ChangeState, "path_follower/change_state", request).success
    drive.peer.until(lambda: ends_with_stop(drive.commands[seen:]), "zero velocity")
    process = drive.controller.process
    if transition == Transition.TRANSITION_ACTIVE_SHUTDOWN:
        drive.peer.until(lambda: process.poll() is not None, "the end of the node")
        assert process.returncode == 0
    else:
        assert process.poll() is None
