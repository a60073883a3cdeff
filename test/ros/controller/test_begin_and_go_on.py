"""Real nodes begin where the job begins, and go on where it stopped."""

from __future__ import annotations

import math

import numpy as np
import pytest
from field_routes import case
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger

from adp_path_follower.bags.reader import read_run
from adp_path_follower.core.geometry import advance_pose
from adp_path_follower.core.path.library import read_poses
from adp_path_follower.ros.runtime.conversions import poses_message
from adp_path_follower.study.replay.replay import replay
from folders import CASES

pytestmark = pytest.mark.nodes

LOCKSTEP = {"control_trigger": "odometry", "odom_timeout": 30.0, "use_sim_time": True}


def simulated(start, route, behind=0.0, turn=0.0, **parameters):
    """Start a simulator with its robot at the first pose of a route, or behind it [m], turned."""
    x, y, heading = route.segments[0].path.frame(0.0).pose.tolist()
    x, y = x - behind * math.cos(heading), y - behind * math.sin(heading)
    start("sim_unicycle", x=x, y=y, theta=heading + turn, **parameters)


def way_of(odometry):
    """Return the positions in odometry messages, shape (N, 2)."""
    return np.array([(item.pose.pose.position.x, item.pose.pose.position.y) for item in odometry])


def farthest_from(route, way):
    samples = route.segments[0].path.samples
    return max(np.hypot(samples.x - x, samples.y - y).min() for x, y in way)


@pytest.mark.parametrize(
    ("name", "paths", "behind", "turn"),
    [
        ("loop_gap_3cm.csv", {}, 0.02, 0.0),
        ("three_laps_noisy.csv", {}, 0.01, 0.0),
        ("lawnmower_lanes_0.5m.csv", {}, 0.0, math.radians(149.0)),
    ],
)
def test_all_of_a_path_is_driven(peer, start, name, paths, behind, turn):
    odometry = peer.listen(Odometry, "odom", 10_000)
    controller = start("controller", desired_speed=0.9, learning=False, **paths, **LOCKSTEP)
    route = case(name)
    simulated(start, route, behind, turn, lockstep=True, rate=25.0)
    peer.until_matched(peer.path)
    peer.until(lambda: odometry, "odometry of the beginning")
    start("path_publisher", path=str(CASES / name))
    peer.until(lambda: "goal reached" in controller.output(), "the goal", timeout=120.0)
    assert f"begins at 0.0 of {route.length:.1f} m" in controller.output()
    end = route.segments[0].path.frame(route.length).pose[:2]
    peer.until(lambda: math.dist(way_of(odometry[-1:])[0], end) < 0.2, "odometry of the end")
    assert np.hypot(*np.diff(way_of(odometry), axis=0).T).sum() > route.length - 0.3


@pytest.mark.parametrize(
    ("name", "told", "end", "heading"),
    [
        ("turn_on_the_spot.csv", "1 turned to on the spot", 0.0, math.pi),
        ("goal_yaw.csv", "to heading 2.00 rad at the end", 1.0, 2.0),
    ],
)
def test_turns_on_the_spot_are_driven_as_such(peer, start, name, told, end, heading):
    odometry = peer.listen(Odometry, "odom", 10_000)
    reversing = {"allow_reversing": True, "min_linear_vel": -0.3}
    controller = start("controller", learning=False, **reversing, **LOCKSTEP)
    start("sim_unicycle", lockstep=True, rate=25.0)
    peer.until_matched(peer.path)
    peer.until(lambda: odometry, "odometry of the beginning")
    start("path_publisher", path=str(CASES / name))
    peer.until(lambda: "goal reached" in controller.output(), "the goal", timeout=120.0)
    assert told in controller.output()

    def is_there() -> bool:
        rotation = odometry[-1].pose.pose.orientation
        turn = 2.0 * math.atan2(rotation.z, rotation.w) - heading
        near = abs(way_of(odometry[-1:])[0, 0] - end) < 0.06
        return near and abs(math.remainder(turn, math.tau)) < 0.1

    peer.until(is_there, "odometry of the end")
    assert min(item.twist.twist.linear.x for item in odometry) >= 0.0
    assert way_of(odometry)[:, 0].max() == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize(("name", "kind"), [("loop_closed_false.yaml", "open, 3.77 m")])
def test_a_file_that_says_that_it_is_open_is_open(peer, start, name, kind):
    controller = start("controller")
    start("path_publisher", path=str(CASES / name))
    peer.until(lambda: "new path" in controller.output(), "the path")
    assert f"new path: {kind}" in controller.output()


def test_a_stopped_robot_goes_on_where_it_stopped_and_replays(peer, start, tmp_path):
    odometry = peer.listen(Odometry, "odom", 10_000)
    controller = start(
        "controller", desired_speed=0.8, path_closed="open", path_start="beginning", learning=False
    )
    recorder = start("recorder", output=str(tmp_path / "bag"))
    route = case("loop_2m.csv")
    simulated(start, route)
    peer.until_matched(peer.path)
    heard = ("odom", "path_follower/status")  # zero velocities end before a late recorder hears one
    peer.until(
        lambda: all(f"recording /{topic}\n" in recorder.output() for topic in heard), "a recorder"
    )
    start("path_publisher", path=str(CASES / "loop_2m.csv"))
    peer.until(
        lambda: odometry and odometry[-1].pose.pose.position.y > 2.0, "a quarter of the loop"
    )
    assert peer.call(Trigger, "path_follower/stop").success
    peer.until(lambda: odometry and odometry[-1].twist.twist.linear.x == 0.0, "the stop")
    assert peer.call(Trigger, "path_follower/resume").success
    peer.until(
        lambda: odometry and odometry[-1].pose.pose.position.x < -0.2, "more than half of the loop"
    )
    assert "goes on at 3." in controller.output() or "goes on at 4." in controller.output()
    for node in (controller, recorder):
        node.stop()
    assert farthest_from(route, way_of(odometry)[::10]) < 0.05
    again = replay(read_run(tmp_path / "bag"))
    assert again.answered.sum() > 200
    assert again.identical[again.answered].all()


def test_a_path_that_is_shortened_while_driving_is_gone_on_with_and_replays(peer, start, tmp_path):
    """As planners do; with a turn on the spot, and a stop in it."""
    odometry = peer.listen(Odometry, "odom", 10_000)
    controller = start("controller", learning=False, max_linear_decel=1.0)
    recorder = start("recorder", output=str(tmp_path / "bag"))
    start("sim_unicycle")
    peer.until_matched(peer.path)
    # The status is latched; zero velocities end before a late recorder hears one.
    heard = "recording /path_follower/status\n"
    peer.until(lambda: heard in recorder.output(), "a recorder")
    poses, _ = read_poses(CASES / "turn_on_the_spot.csv")
    peer.path.publish(poses_message(poses, "odom", 0))
    peer.until(lambda: "recording /path\n" in recorder.output(), "a recorder of the first path")
    peer.until(lambda: odometry and odometry[-1].pose.pose.position.x > 0.3, "a beginning")
    peer.path.publish(poses_message(poses[4:], "odom", 0))
    turning = lambda: odometry[-1].pose.pose.orientation.z > 0.3  # noqa: E731
    peer.until(turning, "a turn")
    assert peer.call(Trigger, "path_follower/stop").success
    assert peer.call(Trigger, "path_follower/resume").success
    peer.until(lambda: "goal reached" in controller.output(), "the goal")
    assert controller.output().count("goes on at") == 2
    for node in (controller, recorder):
        node.stop()
    assert way_of(odometry)[:, 0].max() == pytest.approx(1.0, abs=0.06)
    again = replay(read_run(tmp_path / "bag"))
    assert again.answered.sum() > 200
    assert again.identical[again.answered].all()


def test_odometry_without_velocities_drives_as_well(peer, start):
    """As of cameras: a pose thirty times a second, and a twist of zeros."""
    commands = peer.listen(TwistStamped, "cmd_vel")
    controller = start("controller", desired_speed=1.5, learning=False)
    pose = np.array([0.0, 0.1, 0.0])

    def send() -> None:
        nonlocal pose
        if commands:
            twist = commands[-1].twist
            pose = advance_pose(pose, twist.linear.x, twist.angular.z, 1.0 / 30.0)
        peer.send_odometry(tuple(pose.tolist()))

    peer.until_matched(peer.odometry, peer.path)
    peer.node.create_timer(1.0 / 30.0, send)
    peer.send_path()
    peer.until(lambda: pose[0] > 3.0, "three metres")
    text = controller.output()
    assert text.count("odometry has no velocity") == 1
    assert "velocity does not explain" not in text
    assert "'desired_speed' is 1.5 m/s, but 'max_linear_vel' 1" in text
