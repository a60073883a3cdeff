"""Paths in frames that move beneath the robot, over a real /tf."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped, TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger

from adp_path_follower.analysis.recorded_run import drive_of
from adp_path_follower.bags.reader import read_run
from adp_path_follower.core.geometry import (
    FloatArray,
    pose_in_frame,
    tracking_error,
    yaw_of_quaternion,
)
from adp_path_follower.ros.runtime.conversions import poses_message, quaternion_of
from adp_path_follower.study.replay.replay import replay
from live_nodes import Drive, is_zero

pytestmark = pytest.mark.nodes

LOCKSTEP = {"control_trigger": "odometry", "odom_timeout": 30.0, "use_sim_time": True}
SMALL = {"basis_degree": 4, "sample_count": 64, "samples_per_step": 64}  # fast on a loaded machine
ACCELERATIONS = {"max_linear_accel": 2.0, "max_linear_decel": 2.0, "max_angular_accel": 6.0}
PERIOD = 0.02  # [s]
START = np.array([1.0, 2.0, 0.3])  # of the robot in the map


def seconds(stamp: Any) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec


def yaw(turn: Any) -> float:
    return yaw_of_quaternion(turn.x, turn.y, turn.z, turn.w)


class Mapped:
    """A simulated robot whose localisation the test corrects, and a straight path in the map."""

    def __init__(self, peer: Any, start: Any, tmp_path: Any, **parameters: Any) -> None:
        from tf2_msgs.msg import TFMessage

        self.peer, self.bag = peer, tmp_path / "bag"
        self.commands = peer.listen(TwistStamped, "cmd_vel")
        self.truth = peer.listen(Odometry, "ground_truth")
        self.transforms = peer.listen(TFMessage, "/tf")
        self.controller = start("controller", **LOCKSTEP, **SMALL, **parameters)
        self.recorder = start("recorder", output=str(self.bag), use_sim_time=True)
        start(
            "sim_unicycle",
            lockstep=True,
            rate=1.0 / PERIOD,
            map_offset=tuple(START.tolist()),
            map_drift=(0.0, 0.05, 0.0),
        )
        peer.until_matched(peer.path)
        peer.until_recorded()
        self.place = START
        x = np.linspace(0.0, 60.0, 601)
        line = np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])
        peer.path.publish(poses_message(pose_in_frame(line, START), "map", 0))

    @property
    def now(self) -> float:
        """Return the simulated time [s]."""
        return seconds(self.truth[-1].header.stamp) if self.truth else 0.0

    def correct(self, change: list[float]) -> None:
        """Let the localisation jump."""
        self.place = self.place + change
        values = self.place.tolist()
        assert self.peer.set_parameter("unicycle_sim", "map_offset", values).successful

    def until(self, time: float) -> None:
        """Wait for a simulated time [s]."""
        self.peer.until(lambda: self.now >= time, f"simulated time {time:g} s", 60.0)

    def beside(self) -> tuple[FloatArray, FloatArray]:
        """Return time [s] and distance from the path in the map [m], (N,) each."""
        places = {}
        for message in self.transforms:
            for item in message.transforms:
                if item.child_frame_id == "odom":
                    moved = item.transform.translation
                    places[seconds(item.header.stamp)] = np.array(
                        [moved.x, moved.y, yaw(item.transform.rotation)]
                    )
        time, beside = [], []
        for message in self.truth:
            stamp, pose = seconds(message.header.stamp), message.pose.pose
            if stamp in places:
                own = np.array([pose.position.x, pose.position.y, yaw(pose.orientation)])
                time.append(stamp)
                beside.append(tracking_error(pose_in_frame(own, places[stamp]), START)[1])
        return np.array(time), np.array(beside)


def test_localisation_that_drifts_and_jumps_is_followed(interfaces, peer, start, tmp_path):
    robot = Mapped(peer, start, tmp_path, **ACCELERATIONS)
    robot.until(10.0)
    jumped = robot.now
    robot.correct([0.0, 0.6, 0.0])
    robot.until(jumped + 6.0)
    time, beside = robot.beside()
    assert np.abs(beside[(time > 8.0) & (time < jumped)]).max() < 0.01
    assert np.abs(beside[time > jumped]).max() > 0.5
    assert np.abs(beside[time > jumped + 5.0]).max() < 0.12  # as this cost has it
    for one, other in itertools.pairwise(robot.commands):
        assert abs(other.twist.linear.x - one.twist.linear.x) <= 2.0 * PERIOD + 1e-9
        assert abs(other.twist.angular.z - one.twist.angular.z) <= 6.0 * PERIOD + 1e-9
    robot.correct([3.0, 0.0, 0.0])
    peer.until(lambda: "more than max_correction allows" in robot.controller.output(), "the stop")
    peer.until(lambda: is_zero(robot.commands[-1]), "zero velocity")
    peer.call(Trigger, "path_follower/resume")
    peer.until(lambda: not is_zero(robot.commands[-1]), "motion")
    robot.controller.stop()
    robot.recorder.stop()
    run = read_run(robot.bag)
    found = replay(run)
    assert found.answered.sum() > 500
    assert found.identical[found.answered].all()
    drive = drive_of(robot.bag, run)
    assert drive.frames == ("map", "odom")
    seen = np.interp(time, 1e-9 * drive.start + drive.odometry.time, drive.projection.cross_track)
    assert np.abs(seen - beside)[(time > 2.0) & (time < jumped - 0.1)].max() < 0.005


def test_a_path_waits_for_its_transform_and_is_refused_where_none_can_come(interfaces, peer, start):
    from tf2_msgs.msg import TFMessage

    tf = peer.node.create_publisher(TFMessage, "/tf", 10)
    drive = Drive(peer, start)
    output = drive.controller.output
    for frame, text in (("", "path is in frame ''"), ("/map", "path is in frame '/map'")):
        peer.send_path(frame=frame)
        peer.until(lambda text=text: f"path rejected: {text}" in output(), text)
    peer.send_path("circle:0.5", frame="map")
    peer.until(lambda: "the new path waits, and the present one stays" in output(), "the pending")
    drive.until_moving()
    peer.until_matched(tf)

    def send(age: float) -> None:
        item = TransformStamped(child_frame_id="odom")
        now = peer.node.get_clock().now().nanoseconds - round(1e9 * age)
        item.header.stamp.sec, item.header.stamp.nanosec = divmod(now, 1_000_000_000)
        item.header.frame_id, item.transform.rotation = "map", quaternion_of(0.0)
        tf.publish(TFMessage(transforms=[item]))

    for _ in range(20):
        send(3600.0)
        peer.pause(0.02)
    assert "new path: closed" not in output()
    timer = peer.node.create_timer(0.05, lambda: send(0.0))
    peer.until(lambda: "new path: closed" in output(), "the path in the map")
    drive.until_moving()
    peer.node.destroy_timer(timer)
    drive.until_stopped()
    drive.until_diagnosed("waiting: the transform from 'odom' to 'map' is older", level=b"\x01")
    change = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
    assert peer.call(ChangeState, "path_follower/change_state", change).success
    change.transition.id = Transition.TRANSITION_CLEANUP
    assert peer.call(ChangeState, "path_follower/change_state", change).success
    peer.until(lambda: not tf.get_subscription_count(), "nobody who listens to /tf")
