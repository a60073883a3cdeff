"""Paths on their way into the controller: their bytes, frames and the thread that fits them."""

from __future__ import annotations

import math
import threading
import time
from pathlib import Path as FilePath

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, TwistStamped
from hypothesis import given, settings
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.serialization import serialize_message

from adp_path_follower.analysis.recorded_run import drive_of
from adp_path_follower.bags.reader import read_run
from adp_path_follower.core.settings.groups import PathSettings
from adp_path_follower.messages.raw import CdrError, is_empty, read_path
from adp_path_follower.ros.controller.path_input import PathIntake, PathRequest, answer
from adp_path_follower.ros.controller.path_process import route_of_message
from adp_path_follower.ros.runtime.conversions import quaternion_of
from adp_path_follower.study.replay.replay import replay
from live_nodes import is_zero

LINE = np.stack([np.linspace(0.0, 4.0, 41), np.zeros(41), np.zeros(41)], axis=1)


def message_of(poses: np.ndarray, frame: str = "odom", names: list[str] | None = None):
    message = PathMessage()
    message.header.frame_id = frame
    for number, (x, y, heading) in enumerate(poses.tolist()):
        pose = PoseStamped()
        pose.header.frame_id = names[number % len(names)] if names else frame
        pose.pose.position.x, pose.pose.position.y = x, y
        if not math.isnan(heading):
            pose.pose.orientation = quaternion_of(heading)
        else:
            pose.pose.orientation.w = 0.0
        message.poses.append(pose)
    return message


@settings(max_examples=60)
@given(
    rows=st.lists(
        st.tuples(
            st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(-3.1, 3.1) | st.just(math.nan)
        ),
        max_size=9,
    ),
    frame=st.text("abcäß/_", max_size=9),
    names=st.lists(st.sampled_from(["", "odom", "a_longer_name", "map"]), max_size=3),
)
def test_bytes_are_read_as_the_message_has_them(rows, frame, names):
    poses = np.array(rows, dtype=float).reshape(-1, 3)
    found = read_path(serialize_message(message_of(poses, frame, names)))
    assert found.frame == frame
    np.testing.assert_allclose(found.poses, poses, atol=1e-9)


@settings(max_examples=100)
@given(cut=st.integers(0, 700), place=st.integers(0, 699), value=st.integers(0, 255))
def test_damaged_bytes_are_refused_or_read_and_nothing_else(cut, place, value):
    raw = bytearray(serialize_message(message_of(LINE[:8], names=["odom", "a_longer_name"])))
    raw[place % len(raw)] = value
    for damaged in (bytes(raw), bytes(raw[:cut])):
        try:
            poses = read_path(damaged).poses
        except CdrError:
            continue
        assert poses.shape == (len(poses), 3)
        assert answer(PathRequest(damaged, PathSettings())) is not None


def test_an_empty_path_is_known_at_once():
    assert is_empty(serialize_message(message_of(LINE[:0])))
    assert not is_empty(serialize_message(message_of(LINE[:1])))
    assert not is_empty(b"")


def request_of(poses: np.ndarray, **values: object) -> PathRequest:
    return PathRequest(serialize_message(message_of(poses)), PathSettings(**values))


def test_the_latest_path_counts_and_settings_that_change_ask_again():
    ready = threading.Event()
    intake = PathIntake(ready.set)
    try:
        longer = np.repeat(LINE, 500, axis=0) + np.linspace(0.0, 1e-3, 20_500)[:, None]
        intake.submit(request_of(longer))
        intake.submit(request_of(LINE))
        assert ready.wait(30.0)
        found = intake.take(PathSettings())
        assert found is not None
        assert found.route.length == pytest.approx(4.0)
        assert intake.take(PathSettings()) is None
        ready.clear()
        intake.submit(request_of(LINE))
        assert ready.wait(30.0)
        ready.clear()
        changed = PathSettings(path_tolerance=0.2)
        assert intake.take(changed) is None
        assert ready.wait(30.0)
        assert intake.take(changed).request.settings == changed
        ready.clear()
        intake.submit(request_of(LINE))
        intake.cancel()
        assert not ready.wait(0.3) or intake.take(PathSettings()) is None
    finally:
        intake.close()


def test_the_same_path_again_is_answered_again():
    ready = threading.Event()
    intake = PathIntake(ready.set)
    try:
        for _ in range(3):
            ready.clear()
            intake.submit(request_of(LINE))
            assert ready.wait(30.0)
            assert intake.take(PathSettings()).route is not None
            time.sleep(0.05)  # the thread waits again
            intake.cancel()
    finally:
        intake.close()


def test_a_path_that_cannot_be_fitted_for_whatever_reason_is_refused_and_the_next_is_not():
    ready = threading.Event()

    def defective(raw, settings):
        if settings.path_tolerance == 0.0:
            raise LookupError("a defect")
        return route_of_message(raw, settings)

    intake = PathIntake(ready.set, defective)
    try:
        for tolerance in (0.0, 0.05):
            ready.clear()
            intake.submit(request_of(LINE, path_tolerance=tolerance))
            assert ready.wait(30.0)
            found = intake.take(PathSettings(path_tolerance=tolerance))
            assert (found.route is None) == (tolerance == 0.0)
            assert ("LookupError: a defect" in found.problem) == (tolerance == 0.0)
    finally:
        intake.close()


def test_closing_does_not_wait_for_a_path_that_takes_for_ever():
    fitting, end, answered = threading.Event(), threading.Event(), threading.Event()

    def endless(raw, settings):
        fitting.set()
        end.wait()
        return route_of_message(raw, settings)

    intake = PathIntake(answered.set, endless)
    intake.submit(request_of(LINE))
    assert fitting.wait(30.0)
    closing = threading.Thread(target=intake.close)
    closing.start()
    closing.join(30.0)
    try:
        assert not closing.is_alive()
    finally:
        end.set()
    assert not answered.wait(0.5)


# --- real nodes ---------------------------------------------------------------------------------


def replayed(bag: FilePath) -> tuple[object, object]:
    run = read_run(bag)
    found = replay(run)
    assert found.answered.sum() > 50
    assert found.identical[found.answered].all()
    return run, found


@pytest.mark.nodes
def test_a_route_is_driven_backwards_and_replays(peer, start, tmp_path):
    """There, a stop, and back; the same path again changes nothing, an empty one stops."""
    commands = peer.listen(TwistStamped, "cmd_vel")
    odometry = peer.listen(Odometry, "odom")
    controller = start("controller", allow_reversing=True, min_linear_vel=-0.5)
    recorder = start("recorder", output=str(tmp_path / "bag"))
    start("sim_unicycle")
    peer.until_matched(peer.path)
    peer.until_recorded()
    there = np.stack([np.linspace(0.0, 1.2, 25), np.zeros(25), np.zeros(25)], axis=1)
    back = np.stack([np.linspace(1.15, 0.0, 24), np.linspace(0.0, 0.1, 24), np.zeros(24)], axis=1)
    message = message_of(np.vstack([there, back]))
    peer.path.publish(message)
    peer.until(lambda: any(item.twist.linear.x > 0.1 for item in commands), "forwards")
    peer.path.publish(message)
    peer.until(lambda: any(item.twist.linear.x < -0.1 for item in commands), "backwards")
    first_back = next(i for i, item in enumerate(commands) if item.twist.linear.x < -0.1)
    assert any(map(is_zero, commands[first_back - 60 : first_back]))
    # A single command may be over before the simulator takes its next step.
    peer.until(lambda: odometry and odometry[-1].pose.pose.position.x < 0.6, "some way back")
    peer.path.publish(message_of(LINE[:0]))
    peer.until(lambda: is_zero(commands[-1]), "the stop")
    assert controller.output().count("new path") == 1
    assert "2 segments, 1 of them in reverse" in controller.output()
    controller.stop()
    recorder.stop()
    run, found = replayed(tmp_path / "bag")
    assert found.replayed[:, 0].min() < -0.1
    drive = drive_of(tmp_path / "bag", run)
    assert [segment.reverse for segment in drive.segments] == [False, True]
    assert set(drive.segment_of_pose) == {0, 1}
    assert np.abs(drive.projection.cross_track[drive.driving]).max() < 0.05
    assert not any("passed over" in note for note in drive.notes)
