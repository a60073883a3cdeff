"""Limits of the running node: speed_limit, stops, other paths; and that all of it replays."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from adp_path_follower.bags.reader import read_run
from adp_path_follower.messages.configuration import parse_configuration
from adp_path_follower.study.replay.replay import replay

pytestmark = pytest.mark.nodes

LIMITS = {"max_linear_accel": 0.4, "max_linear_decel": 0.6, "max_angular_accel": 1.5}


def speeds(commands):
    """Return stamps [s] and linear velocities of commands."""
    stamps = [
        message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec for message in commands
    ]
    return np.array(stamps), np.array([message.twist.linear.x for message in commands])


@pytest.mark.parametrize("model", ["ideal", "learned"])
def test_a_run_with_limits_stops_and_other_paths_keeps_them_and_replays(
    peer, start, tmp_path, model
):
    commands = peer.listen(TwistStamped, "cmd_vel")
    controller = start("controller", **LIMITS, actuation_delay=0.05, robot_model=model)
    recorder = start("recorder", output=str(tmp_path / "bag"))
    start("sim_unicycle", x=-0.3, y=0.2, command_delay=0.05)
    publisher = start("path_publisher", path="line")
    limit = peer.node.create_publisher(Float64, "speed_limit", 1)

    def drive_on() -> None:
        count = len(commands)
        peer.until(lambda: len(commands) > count + 100, "a hundred commands")

    heard = ("cmd_vel", "path", "path_follower/configuration", "path_follower/measured_pose")
    heard = (*heard, "path_follower/measured_motion")
    peer.until(
        lambda: all(f"recording /{topic}\n" in recorder.output() for topic in heard),
        "the recorder",
    )
    peer.until_matched(limit)
    drive_on()
    limit.publish(Float64(data=0.2))
    peer.until(lambda: 0.0 < commands[-1].twist.linear.x <= 0.2, "a slower robot")
    assert peer.set_parameter("path_publisher", "path", "circle:0.4").successful
    drive_on()
    assert peer.call(Trigger, "path_follower/stop").success
    peer.until(lambda: commands and commands[-1].twist.linear.x == 0.0, "the stop")
    assert peer.call(Trigger, "path_follower/resume").success
    drive_on()
    limit.publish(Float64(data=math.inf))
    peer.until(lambda: commands and commands[-1].twist.linear.x > 0.3, "a faster robot")
    for node in (publisher, controller, recorder):
        node.stop()
    stamps, found = speeds(commands)
    driving = (found[1:] > 0.0) & (found[:-1] > 0.0)  # without the stops, which are immediate
    change = np.diff(found)[driving]
    elapsed = np.diff(stamps)[driving]
    assert (change <= 0.4 * elapsed + 1e-6).all()  # stamps as float seconds know 0.2 µs
    assert (change >= -0.6 * elapsed - 1e-6).all()
    first = np.flatnonzero((found[1:] > 0.0) & (found[:-1] == 0.0)) + 1
    waited = np.maximum(stamps[first] - stamps[first - 1], 0.01)  # a period, from rest
    assert (found[first] <= 0.4 * waited + 1e-6).all()
    run = read_run(tmp_path / "bag")
    changes = [parse_configuration(text) for _, text in run.configurations]
    limits = [change.values["speed_limit"] for change in changes]
    assert [value for value, _ in itertools.groupby(limits)] == [math.inf, 0.2, math.inf]
    assert changes[-1].counts.stops >= 1  # a busy machine may add some
    again = replay(run)
    assert again.answered.sum() > 300
    assert again.identical[again.answered].all()
