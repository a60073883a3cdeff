"""Paths are prepared in a process of its own, which is replaced when it has ended or stalls."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path as FilePath

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.duration import Duration
from rclpy.serialization import serialize_message

from adp_path_follower.core.errors import AdpError, PathError
from adp_path_follower.core.path.library import circle, lissajous
from adp_path_follower.core.settings.groups import PathSettings
from adp_path_follower.messages.raw import CdrError
from adp_path_follower.ros.controller import path_process
from adp_path_follower.ros.controller.path_process import FittingProcess, reason, route_of_message
from adp_path_follower.ros.runtime.conversions import poses_message
from live_nodes import Drive, is_zero, running_script

EIGHT = serialize_message(poses_message(lissajous().points(0.05), "odom", 0))
CIRCLE = serialize_message(poses_message(circle(1.0).points(0.05), "odom", 0))
SPOT = serialize_message(poses_message(lissajous().points(1e3), "odom", 0))[:60]


def test_the_route_is_the_one_that_is_made_here():
    with FittingProcess() as fitting:
        for tolerance in (0.0, 0.05):
            settings = PathSettings(path_tolerance=tolerance)
            there = fitting.route(EIGHT, settings)
            here = route_of_message(EIGHT, settings)
            assert there.digest() == here.digest()
            pose = np.array([1.0, 0.5, 0.2])
            assert there.nearest(pose) == here.nearest(pose)


@pytest.mark.parametrize(
    "raw",
    [b"", b"\0\1\0\0", SPOT, EIGHT[:-3], EIGHT[:3000]],
    ids=["nothing", "no header", "no pose", "cut at its end", "cut"],
)
def test_what_is_refused_is_refused_with_the_same_words(raw):
    with pytest.raises((AdpError, CdrError)) as here:
        route_of_message(raw, PathSettings())
    with FittingProcess() as fitting:
        with pytest.raises(PathError) as there:
            fitting.route(raw, PathSettings())
        assert str(there.value) == reason(here.value)
        assert fitting.route(EIGHT, PathSettings()).closed  # and it goes on


def test_a_process_that_has_ended_meanwhile_is_replaced():
    with FittingProcess() as fitting:
        for _ in range(2):
            ended = fitting._process.pid
            os.kill(ended, signal.SIGKILL)
            _until_dead(ended)
            assert fitting.route(EIGHT, PathSettings()).closed
            assert fitting._process.pid != ended


def test_an_answer_that_cannot_be_taken_is_not_taken_for_the_next_one(monkeypatch):
    def fail(size):
        raise MemoryError(f"no {size} bytes")

    with FittingProcess() as fitting:
        with monkeypatch.context() as patch:
            patch.setattr(path_process, "_receive", fail)
            with pytest.raises(PathError, match="unexpected MemoryError: no"):
                fitting.route(EIGHT, PathSettings())
        assert fitting.route(CIRCLE, PathSettings()).length < 10.0


def kill_itself(*request):
    os.kill(os.getpid(), signal.SIGKILL)


def fail(*request):
    raise LookupError("a defect")


def stop_itself(*request):
    os.kill(os.getpid(), signal.SIGSTOP)


@pytest.mark.parametrize(
    ("defect", "told"),
    [
        (kill_itself, r"the process at work on it has ended \(exit code -9\); publish it again"),
        (fail, "path cannot be prepared: unexpected LookupError: a defect"),
        (stop_itself, "path was not prepared within 2 s: publish it again"),
    ],
)
def test_a_path_that_the_process_is_lost_at_is_refused(monkeypatch, defect, told):
    with monkeypatch.context() as patch:
        patch.setattr(path_process, "route_of_message", defect)
        fitting = FittingProcess()  # a fork, which has the defect; what replaces it does not
    with fitting:
        first = fitting._process.pid
        with monkeypatch.context() as patch:
            if defect is stop_itself:
                patch.setattr(path_process, "_PATIENCE", 1.0)
            with pytest.raises(PathError, match=told):
                fitting.route(EIGHT, PathSettings())
        if defect is fail:
            assert fitting._process.pid == first  # and goes on
            return
        assert fitting.route(EIGHT, PathSettings()).closed
        assert fitting._process.pid != first


def test_a_machine_with_no_process_left_prepares_paths_all_the_same(monkeypatch):
    def fork():
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "fork", fork)
    with FittingProcess() as fitting:
        assert fitting.route(EIGHT, PathSettings()).closed


def test_a_process_that_is_told_to_end_ends_the_thread_that_asks(capfd, monkeypatch):
    """It says nothing: nobody needs a path any more."""
    ended, receive, waits = [], path_process._receive, threading.Event()

    def noted(*arguments):
        waits.set()
        return receive(*arguments)

    monkeypatch.setattr(path_process, "_receive", noted)

    def ask() -> None:
        with pytest.raises(SystemExit):
            fitting.route(EIGHT, PathSettings())
        ended.append(True)

    with FittingProcess() as fitting:
        os.kill(fitting._process.pid, signal.SIGSTOP)  # it answers when it is told
        asking = threading.Thread(target=ask)
        asking.start()
        assert waits.wait(30.0)
    asking.join()
    assert ended
    assert capfd.readouterr().err == ""


ENDING_BEFORE_ITS_PATH = """
import sys, threading, time
from adp_path_follower.ros.controller import path_process
from adp_path_follower.ros.controller.node import PathFollowerNode

gone, got = threading.Event(), threading.Event()
route, destroy = path_process.FittingProcess.route, PathFollowerNode.destroy_node


def late(self, *request):
    print("asked for a route", flush=True)
    gone.wait()
    found = route(self, *request)
    print("got the route", flush=True)
    got.set()
    return found


def destroy_first(self):
    destroy(self)
    gone.set()
    assert got.wait(30.0)
    time.sleep(0.5)  # the thread goes on with it


path_process.FittingProcess.route, PathFollowerNode.destroy_node = late, destroy_first
sys.exit(path_process.main())
"""


@pytest.mark.nodes
def test_a_path_that_is_ready_when_the_node_is_gone_is_no_error(
    peer, domain, node_server, tmp_path
):
    log = tmp_path / "controller.log"
    with running_script(node_server, ENDING_BEFORE_ITS_PATH, domain, log) as process:
        peer.send_path()
        peer.until(lambda: "asked for a route" in log.read_text(), "a path on its way")
        process.send_signal(signal.SIGINT)
        assert process.wait(30.0) == 0
    assert "got the route" in log.read_text()
    assert "Traceback" not in log.read_text()


def children(pid: int) -> list[int]:
    """Return the processes that a process has started."""
    text = FilePath(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(number) for number in text.split()]


def until_followed(drive, number: int) -> None:
    """Wait until the controller follows its so many-th path."""
    drive.peer.until(lambda: drive.controller.output().count("new path") == number, "the path")
    drive.until_moving()


@pytest.mark.nodes
def test_the_controller_goes_on_when_the_process_has_ended(drive):
    (fitting,) = children(drive.controller.process.pid)
    os.kill(fitting, signal.SIGINT)  # Ctrl-C reaches it, too, and is for the node
    drive.peer.send_path("circle:0.5")
    until_followed(drive, 2)
    assert children(drive.controller.process.pid) == [fitting]
    os.kill(fitting, signal.SIGKILL)
    _until_dead(fitting)
    drive.peer.send_path("line")
    until_followed(drive, 3)
    assert "the process that prepares paths has ended" in drive.controller.output()
    assert drive.controller.stop() == 0
    drive.peer.until(lambda: is_zero(drive.commands[-1]), "the stop")


@pytest.mark.nodes
def test_a_path_that_the_process_is_killed_at_is_refused_and_the_next_is_not(drive):
    (fitting,) = children(drive.controller.process.pid)
    os.kill(fitting, signal.SIGSTOP)  # so that it is at the path when it is killed
    drive.peer.send_path("circle:0.5")
    assert drive.peer.path.wait_for_all_acked(Duration(seconds=30))
    drive.until_commands(50)
    os.kill(fitting, signal.SIGKILL)
    drive.until_diagnosed("path rejected: path cannot be prepared: the process at work on it has")
    drive.until_moving()  # along the path before
    drive.peer.send_path("circle:0.4")
    until_followed(drive, 2)


@pytest.mark.nodes
def test_a_process_that_is_stopped_hinders_neither_a_cleanup_nor_the_end(drive):
    (fitting,) = children(drive.controller.process.pid)
    os.kill(fitting, signal.SIGSTOP)
    drive.peer.send_path("circle:0.5")
    assert drive.peer.path.wait_for_all_acked(Duration(seconds=30))
    drive.until_commands(50)
    for transition in (Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_CLEANUP):
        request = ChangeState.Request(transition=Transition(id=transition))
        assert drive.peer.call(ChangeState, "path_follower/change_state", request).success
    assert drive.controller.stop(signal.SIGTERM) == 0
    _until_dead(fitting)


LITTLE_PATIENCE = """
import sys
from adp_path_follower.ros.controller import path_process

answer = path_process.FittingProcess._answer


def answer_and_hurry(self, *request):
    found = answer(self, *request)
    path_process._PATIENCE = 1.0
    return found


path_process.FittingProcess._answer = answer_and_hurry
sys.exit(path_process.main())
"""


@pytest.mark.nodes
def test_a_path_that_a_stopped_process_does_not_prepare_is_refused(
    peer, domain, node_server, tmp_path
):
    log = tmp_path / "controller.log"
    with running_script(node_server, LITTLE_PATIENCE, domain, log) as process:
        drive = Drive(peer, lambda executable: process)
        (fitting,) = children(process.pid)
        os.kill(fitting, signal.SIGSTOP)
        peer.send_path("circle:0.5")
        drive.until_diagnosed("path rejected: path was not prepared within 1 s")
        _until_dead(fitting)
        drive.until_moving()
        process.terminate()
        assert process.wait(30.0) == 0
    assert "Traceback" not in log.read_text()


@pytest.mark.nodes
def test_the_process_ends_with_its_controller_even_if_that_is_killed(drive):
    (fitting,) = children(drive.controller.process.pid)
    os.kill(drive.controller.process.pid, signal.SIGKILL)
    _until_dead(fitting)


def _until_dead(pid: int) -> None:
    end = time.monotonic() + 30.0
    while _runs(pid):
        assert time.monotonic() < end, "it still runs"
        time.sleep(0.01)


def _runs(pid: int) -> bool:
    """Return whether a process is more than an entry that nobody has asked for."""
    try:
        return " Z " not in FilePath(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return False
