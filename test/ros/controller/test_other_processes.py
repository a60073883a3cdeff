"""The robot stops when other processes stall or die: kill -STOP and kill -9 of each."""

from __future__ import annotations

import os
import signal

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from std_srvs.srv import Trigger

from live_nodes import Peer, is_zero, launched, running_script

pytestmark = pytest.mark.nodes

LISTENER = """
import rclpy
from geometry_msgs.msg import TwistStamped, Vector3Stamped
from rclpy.qos import DurabilityPolicy, QoSProfile

rclpy.init()
node = rclpy.create_node("listener")
node.create_subscription(TwistStamped, "cmd_vel", lambda message: None, 1000)
node.create_subscription(Vector3Stamped, "path_follower/tracking_error", lambda message: None, 1000)
latched = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
topic = "path_follower/measured_pose"
node.create_subscription(Vector3Stamped, topic, lambda message: print("heard", flush=True), latched)
rclpy.spin(node)
"""


class Team:
    """All nodes as processes of their own, with a robot that drives a figure eight."""

    def __init__(self, peer: Peer, start) -> None:
        self.peer = peer
        self.commands = peer.listen(TwistStamped, "cmd_vel")
        peer.listen(DiagnosticArray, "/diagnostics")
        # Best effort: a reliable reader may wait for seconds for what a killed process lost.
        self.truth = peer.listen(Odometry, "ground_truth", qos_profile_sensor_data)
        self.controller = start("controller")
        self.simulator = start("sim_unicycle", theta=1.249)
        self.publisher = start("path_publisher")
        self.until_moving()

    def until_moving(self) -> None:
        """Wait for thirty new commands in a row that move the robot, and for its motion."""
        self.commands.clear()
        self.peer.until(
            lambda: len(self.commands) >= 30 and not any(map(is_zero, self.commands[-30:])),
            "commands to move",
        )
        self.truth.clear()
        self.peer.until(lambda: self.truth and self.truth[-1].twist.twist.linear.x > 0.1, "motion")

    def until_told_to_stop(self) -> None:
        """Wait for three zero velocities in a row."""
        self.commands.clear()
        self.peer.until(
            lambda: len(self.commands) >= 3 and all(map(is_zero, self.commands[-3:])),
            "zero velocity",
        )

    def until_at_rest(self) -> None:
        """Wait until the robot stands."""
        self.truth.clear()
        self.peer.until(lambda: self.truth and self.truth[-1].twist.twist.linear.x == 0.0, "rest")


@pytest.fixture
def team(peer, start) -> Team:
    return Team(peer, start)


def test_the_robot_drives_on_and_can_be_stopped_when_those_who_listen_stall_or_die(
    team, start, domain, node_server, tmp_path
):
    recorder = start("recorder", output=str(tmp_path / "bag"))
    log = tmp_path / "listener.log"
    with running_script(node_server, LISTENER, domain, log) as listener:
        recorded = "recording /path_follower/measured_pose"
        team.peer.until(lambda: recorded in recorder.output(), recorded)
        team.peer.until(lambda: "heard" in log.read_text(), "the listener")
        others = (team.publisher.process.pid, recorder.process.pid, listener.pid)
        for number in (signal.SIGSTOP, signal.SIGKILL):
            for pid in others:
                os.kill(pid, number)
                team.until_moving()
            # Every buffer of those who do not take their messages is full by now, or gone.
            count = len(team.commands)
            team.peer.until(lambda n=count: len(team.commands) > n + 100, "a hundred commands")
            assert team.peer.call(Trigger, "path_follower/stop").success
            team.until_told_to_stop()
            team.until_at_rest()
            assert team.peer.call(Trigger, "path_follower/resume").success
            team.until_moving()


def test_the_robot_stops_when_odometry_stalls_or_dies(team):
    os.kill(team.simulator.process.pid, signal.SIGSTOP)
    team.until_told_to_stop()
    team.peer.until_diagnosed("fault: no odometry for more than 0.5 s")
    os.kill(team.simulator.process.pid, signal.SIGCONT)
    team.until_moving()
    os.kill(team.simulator.process.pid, signal.SIGKILL)
    team.until_told_to_stop()


def test_the_base_stops_by_itself_when_the_controller_stalls_or_dies(team):
    """A program that is stopped cannot speak: the base's own command timeout is what is left."""
    os.kill(team.controller.process.pid, signal.SIGSTOP)
    team.until_at_rest()
    os.kill(team.controller.process.pid, signal.SIGCONT)
    team.until_moving()
    os.kill(team.controller.process.pid, signal.SIGKILL)
    team.until_at_rest()


def is_running(pid: int) -> bool:
    """Return whether a process runs; one that nobody has waited for does not."""
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_the_robot_stops_with_whoever_launched_the_controller(peer, domain, tmp_path):
    log = tmp_path / "launched.log"
    with launched(peer, domain, log) as (drive, launcher, pid):
        launcher.kill()
        drive.until_stopped()
        peer.until(lambda: not is_running(pid), "the controller's end")
        assert "the process that started this node has ended" in log.read_text()
        assert "Traceback" not in log.read_text()


@pytest.mark.parametrize("wrapper", ["nohup", "setsid"])
def test_a_controller_that_was_started_to_outlive_its_parent_does(peer, domain, tmp_path, wrapper):
    with launched(peer, domain, tmp_path / "launched.log", wrapper) as (drive, launcher, pid):
        launcher.kill()
        launcher.wait()
        drive.until_commands(50)  # meanwhile it has looked at its parent several times
        drive.until_moving()
        assert is_running(pid)
