"""A peer of real nodes: it publishes, listens and calls on their domain."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile

from adp_path_follower.core.path.library import named_path
from adp_path_follower.ros.runtime.conversions import odometry_message, poses_message
from adp_path_follower.study.demo import NodeProcess
from forked_nodes import ForkedProcess, NodeServer

TIMEOUT = 30.0  # [s] for anything that must happen; a loaded machine is slow, not wrong
_FIRST_ANSWER_TIMEOUT = 8.0  # [s] after which a service is called again
FRAMES = ("odom", "base_link")
CONTROLLER = [sys.executable, "-m", "adp_path_follower.ros.runtime.entry", "controller"]
LAUNCHER = """
import signal, subprocess, sys, time

signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whoever runs the tests may have ignored it (nohup)
node = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)
print(node.pid, flush=True)
time.sleep(1000.0)
"""


class Peer:
    """A node in the test process: publishes, listens and calls."""

    def __init__(self, domain: int) -> None:
        self.context = rclpy.Context()
        self.context.init(domain_id=domain)
        self.node = rclpy.create_node("test_peer", context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.received: dict[str, list[Any]] = {}
        self.sent, self.stamped = 0, 0.0  # odometry messages, and the last stamp [s]
        self._clients: dict[str, Any] = {}
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.odometry = self.node.create_publisher(Odometry, "odom", 10)
        self.path = self.node.create_publisher(PathMessage, "path", latched)

    def listen(self, kind: type, topic: str, qos: Any = 1000) -> list[Any]:
        """Return the list that the topic's messages will be appended to."""
        messages = self.received.setdefault(topic, [])
        self.node.create_subscription(kind, topic, messages.append, qos)
        return messages

    def pause(self, seconds: float) -> None:
        """Take messages for a time, between two messages of the test's own."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.01)

    def until(self, condition: Callable[[], Any], what: str, timeout: float = TIMEOUT) -> None:
        """Take messages until a condition holds; fail with a text if it never does."""
        end = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < end, f"not within {timeout:g} s: {what}"
            self._executor.spin_once(timeout_sec=0.02)

    def until_quiet(self, messages: list[Any], seconds: float = 0.5) -> None:
        """Wait until none has been added to a list of messages for a time [s]."""
        count, since = len(messages), time.monotonic()

        def quiet() -> bool:
            nonlocal count, since
            if len(messages) != count:
                count, since = len(messages), time.monotonic()
            return time.monotonic() - since > seconds

        self.until(quiet, f"{seconds:g} s without a message")

    def until_sent(self, count: int) -> None:
        """Wait until so many more odometry messages have been sent."""
        last = self.sent + count
        self.until(lambda: self.sent >= last, f"{count} odometry messages")

    def until_matched(self, *publishers: Any) -> None:
        """Wait until every publisher has a subscriber."""
        self.until(
            lambda: all(publisher.get_subscription_count() for publisher in publishers),
            "subscribers",
        )

    def until_diagnosed(self, text: str, level: bytes = b"\x02") -> None:
        """Wait for a message of a level, ERROR by default, among /diagnostics listened to."""
        self.until(
            lambda: any(
                text in status.message and status.level == level
                for array in self.received["/diagnostics"]
                for status in array.status
            ),
            f"diagnostics with '{text}'",
        )

    def until_recorded(self) -> None:
        """Wait until the recorder listens to what a replay needs."""
        topics = ("/cmd_vel", "/path", "/path_follower/configuration")
        topics += ("/path_follower/measured_pose",)
        self.until(
            lambda: all(
                "recorder"
                in {info.node_name for info in self.node.get_subscriptions_info_by_topic(topic)}
                for topic in topics
            ),
            "the recorder",
        )

    def call(self, kind: type, name: str, request: Any = None) -> Any:
        """Return the answer of a service."""
        is_new = name not in self._clients
        if is_new:
            self._clients[name] = self.node.create_client(kind, name)
        client = self._clients[name]
        self.until(client.service_is_ready, f"service {name}")
        future = client.call_async(request or kind.Request())
        if is_new:
            # The node may know our requests before it knows where we read: then rmw drops the
            # answer ("client will not receive response").
            end = time.monotonic() + _FIRST_ANSWER_TIMEOUT
            while not future.done() and time.monotonic() < end:
                self._executor.spin_once(timeout_sec=0.02)
            if not future.done():
                client.remove_pending_request(future)
                future = client.call_async(request or kind.Request())
        self.until(future.done, f"answer of {name}")
        return future.result()

    def ask(self, name: str, request: Any) -> Any:
        """Return the future of the answer of a service that has been called before."""
        return self._clients[name].call_async(request)

    def set_parameter(self, node: str, name: str, value: Any) -> Any:
        """Return the result of setting one parameter of another node."""
        from rcl_interfaces.srv import SetParameters

        request = SetParameters.Request()
        request.parameters = [Parameter(name, value=value).to_parameter_msg()]
        return self.call(SetParameters, f"{node}/set_parameters", request).results[0]

    def send_odometry(self, pose: tuple[float, float, float], **changes: Any) -> None:
        """Publish odometry of now.

        `changes` replaces fields like x, qw, v or child_frame_id, to break them; `later` moves the
        stamp [s], `stamp` replaces it, and `back` sets it so long before the last one.
        """
        time = changes.pop("stamp", 1e-9 * self.node.get_clock().now().nanoseconds)
        time = self.stamped - changes.pop("back") if "back" in changes else time
        self.stamped = time + changes.pop("later", 0.0)
        stamp = round(1e9 * self.stamped)
        message = odometry_message(stamp, np.array(pose), np.zeros(2), FRAMES)
        for name, value in changes.items():
            if name == "child_frame_id":
                message.child_frame_id = value
            elif name == "frame_id":
                message.header.frame_id = value
            elif name == "v":
                message.twist.twist.linear.x = value
            elif name.startswith("q"):
                setattr(message.pose.pose.orientation, name[1:], value)
            else:
                setattr(message.pose.pose.position, name, value)
        self.odometry.publish(message)
        self.sent += 1

    def send_path(self, name: str = "line", frame: str = "odom") -> PathMessage:
        """Publish a named path and return the message."""
        message = poses_message(named_path(name).points(0.1), frame, 0)
        self.path.publish(message)
        return message

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@contextlib.contextmanager
def running_script(
    server: NodeServer, text: str, domain: int, log: FilePath
) -> Iterator[ForkedProcess]:
    """Run a Python script as a fork of a server, on a domain; kill it unless it has ended."""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
    process = server.start([], environment, log, script=text)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def is_zero(command: TwistStamped) -> bool:
    """Return whether a command tells the robot to stop."""
    return command.twist.linear.x == 0.0 and command.twist.angular.z == 0.0


def ends_with_stop(commands: list[TwistStamped]) -> bool:
    """Return whether the last three commands tell the robot to stop."""
    return len(commands) >= 3 and all(map(is_zero, commands[-3:]))


class Drive:
    """A controller that follows a line, fed with odometry at rest by the test."""

    def __init__(self, peer: Peer, start: Callable[..., NodeProcess], **parameters: Any) -> None:
        from diagnostic_msgs.msg import DiagnosticArray

        self.peer = peer
        self.commands = peer.listen(TwistStamped, "cmd_vel")
        self.diagnostics = peer.listen(DiagnosticArray, "/diagnostics")
        self.controller = start("controller", **parameters)
        peer.until_matched(peer.odometry, peer.path)
        peer.node.create_timer(0.02, self._send)
        self.odometry: dict[str, Any] | None = {}
        peer.send_path()
        self.until_moving()

    def _send(self) -> None:
        if self.odometry is not None:
            self.peer.send_odometry((0.0, 0.1, 0.0), **self.odometry)

    def until_moving(self) -> None:
        """Wait for ten commands in a row that are not zero."""
        self.commands.clear()
        self.peer.until(
            lambda: len(self.commands) >= 10 and not any(map(is_zero, self.commands[-10:])),
            "commands to move",
        )

    def until_stopped(self) -> None:
        """Wait for three zero commands in a row."""
        self.peer.until(lambda: ends_with_stop(self.commands), "zero velocity")

    def until_commands(self, count: int) -> None:
        """Wait for so many more commands."""
        last = len(self.commands) + count
        self.peer.until(lambda: len(self.commands) >= last, f"{count} commands")

    def until_diagnosed(self, text: str, level: bytes = b"\x02") -> None:
        """Wait for a diagnostic message of a level, ERROR by default, that contains a text."""
        self.peer.until_diagnosed(text, level)


@contextlib.contextmanager
def launched(peer: Peer, domain: int, log, *wrapper: str):
    """Yield a robot that moves, whose controller is the child of a launcher, and both processes.

    Yields:
        The drive, the launcher, and the controller's process id.

    """

    def start(executable: str) -> None:
        """Leave it to the launcher."""

    with (
        log.open("wb") as output,
        subprocess.Popen(
            [sys.executable, "-c", LAUNCHER, *wrapper, *CONTROLLER],
            env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
            stdout=subprocess.PIPE,
            stderr=output,
        ) as launcher,
    ):
        pid = int(launcher.stdout.readline())
        try:
            yield Drive(peer, start), launcher, pid
        finally:
            launcher.kill()
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
