"""Debug topics: made only for those who listen, and as often as `debug_rate` says."""

import math

import numpy as np
import pytest
from geometry_msgs.msg import Vector3Stamped
from std_msgs.msg import Float64

from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.ros.controller.telemetry import Telemetry
from adp_path_follower.ros.runtime.conversions import stamp_nanoseconds
from live_nodes import Drive

PERIOD = 10_000_000  # [ns]


def told_at(rate):
    return build(Settings, {"debug_rate": rate}).controller


def stamps(messages):
    return [stamp_nanoseconds(message.header) for message in messages]


def test_nothing_is_made_of_a_step_until_somebody_listens(peer):
    telemetry = Telemetry(peer.node, ("a",), lossless=False, controller=lambda: told_at(math.inf))
    nothing = None  # what any message would be made of
    for step in range(5):
        telemetry.step(step * PERIOD, "odom", np.zeros((2, 3)), nothing, 0.0)
    costs = peer.listen(Float64, "test_peer/cost")

    def cost_arrives():
        telemetry.step(9 * PERIOD, "odom", np.zeros((2, 3)), nothing, 7.0)  # the cost comes, too
        return costs

    peer.until(cost_arrives, "the cost")
    assert costs[0].data == 7.0
    peer.listen(Vector3Stamped, "test_peer/tracking_error")
    with pytest.raises(AttributeError, match="'NoneType' object has no attribute 'error'"):
        peer.until(lambda: cost_arrives() and None, "a message of nothing")
    telemetry.destroy()


@pytest.mark.parametrize(
    ("rate", "expected"), [(math.inf, range(30)), (20.0, range(0, 30, 5)), (1000.0, range(30))]
)
def test_of_each_period_the_first_step_is_told(peer, rate, expected):
    follower = PathFollower(build(Settings, {}), named_path("line"))
    output = follower.step(np.array([0.0, 0.1, 0.0]), 0.01)
    telemetry = Telemetry(peer.node, ("a",), lossless=True, controller=lambda: told_at(rate))
    errors = peer.listen(Vector3Stamped, "test_peer/tracking_error")
    costs = peer.listen(Float64, "test_peer/cost")
    before = iter(range(0, 10**15, 10**9))

    def both_arrive():
        telemetry.step(next(before), "odom", np.zeros((2, 3)), output, -1.0)
        return errors and costs

    peer.until(both_arrive, "the first messages")
    start = 1_700_000_000 * 10**9
    for step in range(30):
        telemetry.step(start + step * PERIOD, "odom", np.zeros((2, 3)), output, float(step))
    peer.until(lambda: costs and costs[-1].data == expected[-1], "the last step that is told")
    peer.until(lambda: stamps(errors)[-1] == start + expected[-1] * PERIOD, "that one")
    assert [cost.data for cost in costs if cost.data >= 0.0] == list(expected)
    told = [start + step * PERIOD for step in expected]
    assert [stamp for stamp in stamps(errors) if stamp >= start] == told
    telemetry.destroy()


@pytest.mark.nodes
def test_a_controller_tells_of_as_many_steps_as_it_is_told_to(peer, start):
    poses = peer.listen(Vector3Stamped, "path_follower/measured_pose")
    errors = peer.listen(Vector3Stamped, "path_follower/tracking_error")
    drive = Drive(peer, start, debug_rate=10.0)
    peer.until(lambda: len(poses) >= 200, "two seconds of steps")
    told, steps = stamps(errors), stamps(poses)
    assert set(told) <= set(steps)
    periods = [stamp // 100_000_000 for stamp in told]
    assert len(periods) == len(set(periods)) >= 10  # each once
    drive.until_moving()
    assert peer.set_parameter("path_follower", "debug_rate", math.inf).successful
    peer.until(lambda: max(np.diff(stamps(errors)[-3:])) < 50_000_000, "three steps in a row")
    for messages in (poses, errors):
        messages.clear()
    peer.until(lambda: len(errors) >= 50, "every step")
    assert set(stamps(errors[1:-5])) <= set(stamps(poses))
    assert len(errors) >= 0.8 * len(poses)
    refused = peer.set_parameter("path_follower", "debug_rate", 0.0)
    assert not refused.successful
    assert "debug_rate" in refused.reason
