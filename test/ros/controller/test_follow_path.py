"""The action follow_path over real DDS, as Nav2's own client would ask for it."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.action import ActionClient

from adp_path_follower.analysis.recorded_run import drive_of
from adp_path_follower.bags.reader import read_run
from adp_path_follower.ros.runtime.conversions import poses_message
from adp_path_follower.study.replay.replay import replay
from live_nodes import is_zero

pytestmark = pytest.mark.nodes

PREEMPTIONS = int(os.environ.get("ADP_PREEMPTIONS", "25"))
LOCKSTEP = {"control_trigger": "odometry", "odom_timeout": 30.0, "use_sim_time": True}
ACCELERATIONS = {"max_linear_accel": 1.0, "max_linear_decel": 1.0, "max_angular_accel": 4.0}


def line(start: float, end: float) -> np.ndarray:
    """Return poses along x, 5 cm apart."""
    x = np.linspace(start, end, round((end - start) / 0.05) + 1)
    return np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])


def wave(start: float, end: float) -> np.ndarray:
    """Return poses along a sine, 5 cm apart in x."""
    x = np.linspace(start, end, round((end - start) / 0.05) + 1)
    return np.column_stack([x, 0.5 * np.sin(x), np.arctan(0.5 * np.cos(x))])


class Planner:
    """A client of the action."""

    def __init__(self, peer: Any) -> None:
        from nav2_msgs.action import FollowPath

        self.peer, self.type = peer, FollowPath
        self.client = ActionClient(peer.node, FollowPath, "follow_path")
        self.feedback: list[Any] = []
        self.message = ""  # of the last result
        self.commands = peer.listen(TwistStamped, "cmd_vel")

    def start_robot(self, start: Any, **parameters: Any) -> None:
        """Start the simulator and wait for its odometry."""
        odometry = self.peer.listen(Odometry, "odom")
        start("sim_unicycle", **parameters)
        self.peer.until(lambda: odometry, "odometry")
        self.peer.until(self.client.server_is_ready, "the action server")

    def send(self, poses: np.ndarray, frame: str = "odom", **ids: str) -> Any:
        """Return the handle of an accepted goal."""
        goal = self.type.Goal(path=poses_message(poses, frame, 0), **ids)
        asked = self.client.send_goal_async(goal, lambda item: self.feedback.append(item.feedback))
        self.peer.until(asked.done, "the answer to a goal")
        assert asked.result().accepted
        return asked.result()

    def result(self, handle: Any) -> tuple[int, int]:
        """Return status and error code of a goal when it has ended, and keep its message."""
        asked = handle.get_result_async()
        self.peer.until(asked.done, "the result")
        self.message = asked.result().result.error_msg
        return asked.result().status, asked.result().result.error_code

    def until_moving(self) -> None:
        """Wait for ten commands in a row that are not zero."""
        self.commands.clear()
        self.peer.until(
            lambda: len(self.commands) >= 10 and not any(map(is_zero, self.commands[-10:])),
            "commands to move",
        )


@pytest.fixture
def planner(interfaces, peer, start):
    found = Planner(peer)
    found.controller = start("controller", failure_tolerance=10.0)
    return found


@pytest.fixture
def stepped(interfaces, peer, start):
    """Return a planner whose robot takes its steps with the controller, however loaded it is."""
    found = Planner(peer)
    found.controller = start("controller", failure_tolerance=30.0, **LOCKSTEP, **ACCELERATIONS)
    return found


def test_a_goal_is_reached_and_told_of(stepped, start):
    planner = stepped
    planner.start_robot(start, lockstep=True)
    handle = planner.send(line(0.0, 1.0), controller_id="FollowPath")
    assert planner.result(handle) == (GoalStatus.STATUS_SUCCEEDED, 0)
    assert planner.message == ""
    left = [item.distance_to_goal for item in planner.feedback]
    assert left == sorted(left, reverse=True)
    assert left[0] == pytest.approx(1.0, abs=0.1)
    assert left[-1] < 0.2
    assert 0.45 < max(item.speed for item in planner.feedback) < 0.55


def test_many_preemptions_neither_stop_nor_jolt_the_robot(stepped, start, tmp_path):
    planner, peer, bag = stepped, stepped.peer, tmp_path / "bag"
    recorder = start("recorder", output=str(bag), use_sim_time=True)
    peer.until_recorded()
    followed = peer.listen(PathMessage, "path_follower/goal_path")
    planner.start_robot(start, lockstep=True)
    handles = [planner.send(wave(0.0, 20.0))]
    peer.until(lambda: planner.commands and planner.commands[-1].twist.linear.x > 0.1, "motion")
    planner.commands.clear()
    # The planner has seen the robot a little further on each time.
    for number in range(1, PREEMPTIONS + 1):
        followed.clear()
        handles.append(planner.send(wave(0.01 * number, 20.0)))
        peer.until(lambda: followed, "the next path")
    commands = [item.twist for item in planner.commands]
    assert not any(command.linear.x == 0.0 for command in commands)
    stamps = [item.header.stamp.sec + 1e-9 * item.header.stamp.nanosec for item in planner.commands]
    for (v, w), period in zip(
        np.diff([(item.linear.x, item.angular.z) for item in commands], axis=0),
        np.diff(stamps),
        strict=True,
    ):
        assert abs(v) <= 1.0 * period + 1e-6
        assert abs(w) <= 4.0 * period + 1e-6
    assert planner.controller.output().count("begins at") == 1
    assert planner.result(handles[-2])[0] == GoalStatus.STATUS_ABORTED
    cancelled = handles[-1].cancel_goal_async()
    peer.until(cancelled.done, "the answer to the cancellation")
    assert planner.result(handles[-1])[0] == GoalStatus.STATUS_CANCELED
    assert is_zero(planner.commands[-1])
    planner.controller.stop()
    recorder.stop()
    run = read_run(bag)
    found = replay(run)
    assert found.answered.sum() > 100
    assert found.identical[found.answered].all()
    drive = drive_of(bag, run)
    assert len(drive.segments) == PREEMPTIONS + 1
    assert not any("passed over" in note for note in drive.notes)


def until_at(peer, goal, within):
    """Wait for the robot at a pose, within metres and 0.1 rad.

    The last odometry may come after the result, but the robot goes nowhere else.
    """

    def is_there() -> bool:
        pose = peer.received["odom"][-1].pose.pose
        turn = goal[2] - 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
        away = math.dist((pose.position.x, pose.position.y), goal[:2])
        return away < within and abs(math.remainder(turn, math.tau)) < 0.1

    peer.until(is_there, "the robot at its goal")


def test_goals_where_the_robot_is_are_reached(stepped, start):
    """A planner that plans again at its goal sends a single pose, or a step in any direction."""
    planner = stepped
    planner.start_robot(start, lockstep=True)
    assert planner.result(planner.send(line(0.0, 1.0))) == (GoalStatus.STATUS_SUCCEEDED, 0)
    for poses in ([[1.0, 0.0, 1.2]], [[1.02, 0.0, math.nan], [1.0, 0.0, 0.6]]):
        handles = [planner.send(np.array(poses)) for _ in range(5)]
        assert planner.result(handles[-1]) == (GoalStatus.STATUS_SUCCEEDED, 0)
        until_at(planner.peer, poses[-1], 0.05)


def test_a_single_place_away_from_the_robot_is_reached_straight(stepped, start):
    """Also one behind it, or sent twice, as Nav2's controllers drive to the last pose."""
    planner = stepped
    planner.start_robot(start, lockstep=True)
    for poses in ([[1.0, 0.5, -1.0]] * 3, [[0.8, 0.5, 0.0]], [[0.9, 0.5, 0.0]]):
        handle = planner.send(np.array(poses))
        assert planner.result(handle) == (GoalStatus.STATUS_SUCCEEDED, 0)
        until_at(planner.peer, poses[-1], 0.02)


def test_goals_that_cannot_be_reached_say_why(planner):
    codes = planner.type.Result
    peer = planner.peer
    peer.until(planner.client.server_is_ready, "the action server")
    for name, value in (("failure_tolerance", 0.3), ("movement_time_allowance", 2.0)):
        assert peer.set_parameter("path_follower", name, value).successful
    timer = peer.node.create_timer(0.02, lambda: peer.send_odometry((0.0, 0.1, 0.0)))
    broken = line(0.0, 1.0)
    broken[3, 0] = math.nan
    for poses, given, code, named in (
        (line(0.0, 1.0), {"controller_id": "MPPI"}, codes.INVALID_CONTROLLER, "'MPPI'"),
        (line(0.0, 1.0), {"goal_checker_id": "precise"}, codes.UNKNOWN, "'precise'"),
        (line(0.0, 1.0), {"progress_checker_id": "none"}, codes.UNKNOWN, "'none'"),
        (line(0.0, 0.0)[:0], {}, codes.INVALID_PATH, "no poses"),
        (broken, {}, codes.INVALID_PATH, "nan"),
        (line(0.0, 1.0), {"frame": "/map"}, codes.INVALID_PATH, "'/map'"),
        (line(0.0, 1.0), {"frame": "map"}, codes.TF_ERROR, "map"),
        # The odometry stands still.
        (line(0.0, 5.0), {}, codes.FAILED_TO_MAKE_PROGRESS, "moved less than 0.5 m"),
    ):
        assert planner.result(planner.send(poses, **given)) == (GoalStatus.STATUS_ABORTED, code)
        assert named in planner.message
        assert not planner.commands or is_zero(planner.commands[-1])
    planner.send(line(0.0, 5.0))
    planner.until_moving()
    handle = planner.send(line(0.0, 5.0), frame="map")
    assert planner.result(handle) == (GoalStatus.STATUS_ABORTED, codes.TF_ERROR)
    handle = planner.send(line(0.0, 5.0))
    planner.until_moving()
    peer.node.destroy_timer(timer)
    assert planner.result(handle) == (GoalStatus.STATUS_ABORTED, codes.PATIENCE_EXCEEDED)


def test_the_last_path_commands_wherever_it_comes_from(planner, start):
    planner.start_robot(start)
    peer = planner.peer
    handle = planner.send(line(0.0, 20.0))
    planner.until_moving()
    peer.until_matched(peer.path)
    peer.send_path()
    assert planner.result(handle)[0] == GoalStatus.STATUS_ABORTED
    peer.until(lambda: planner.controller.output().count("new path") == 2, "the path of the topic")
    planner.until_moving()
    handle = planner.send(line(0.0, 21.0))
    peer.until(lambda: planner.controller.output().count("new path") == 3, "the goal's path")
    planner.until_moving()
    assert planner.controller.output().count("begins at") == 1
