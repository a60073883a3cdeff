"""Run a node until it is told to stop, and let it say its last words."""

from __future__ import annotations

import signal
import sys
import time as steady
from collections.abc import Callable
from types import FrameType
from typing import Protocol

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from adp_path_follower.core.errors import AdpError, SettingsError


class RunnableNode(Protocol):
    """What `run_node` asks of a node beyond rclpy's own."""

    finished: bool

    def lingers(self, elapsed: float) -> bool:
        """Return whether to go on for now, so long [s] after the node should have ended."""

    def last_words(self) -> None:
        """Publish what must be said before the node goes; called once, whatever happened."""


class _StopSignal:
    """Remember SIGINT and SIGTERM.

    rclpy's own handlers shut the context down at once, after which nothing can be published; the
    robot must be told to stop first.
    """

    def __init__(self) -> None:
        self.received = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._receive)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self.received = True


class Ending:
    """How most nodes end: at once."""

    finished = False

    def lingers(self, elapsed: float) -> bool:
        """Return False: there is nothing to wait for."""
        return False

    def last_words(self) -> None:
        """Say nothing."""


def run_node(name: str, make_node: Callable[[], Node]) -> int:
    """Spin a node until a signal or until it is finished; return the exit code.

    0 after a regular end, 1 after an error while running, 2 if the node refused its settings.
    Errors are logged as one sentence.
    """
    stop = _StopSignal()
    try:
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rcl raises several types for arguments that it cannot parse
        print(f"{name}: {_one_line(error)}", file=sys.stderr)
        return 2
    code = 0
    node: Node | None = None
    try:
        node = _made(make_node)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not stop.received and not node.finished and rclpy.ok():
            executor.spin_once(timeout_sec=0.1)
        end = steady.monotonic()
        while node.lingers(steady.monotonic() - end) and rclpy.ok():
            executor.spin_once(timeout_sec=0.05)
    except ExternalShutdownException:
        pass
    except AdpError as error:
        get_logger(name).fatal(_one_line(error))
        code = 2 if node is None else 1
    except Exception as error:  # whatever happened, the robot must be told to stop
        get_logger(name).fatal(f"unexpected error, stopping: {_one_line(error)}")
        code = 1
    finally:
        if node is not None:
            if rclpy.ok():
                node.last_words()
            node.destroy_node()
        rclpy.try_shutdown()
        # A second signal while Python finalises would change the exit code.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return code


def _made(make_node: Callable[[], Node]) -> Node:
    """Return the node.

    Raises:
        AdpError: It refused its settings, or rclpy did.

    """
    try:
        return make_node()
    except ValueError as error:
        if isinstance(error, AdpError) or "PARAMETER_NOT_SET" not in str(error):
            raise
        raise SettingsError(
            "a setting is an empty list, [], which ROS 2 does not pass on: leave it out"
        ) from None


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split()).split(", at /")[0]  # rcl names its own source files
    return text if isinstance(error, AdpError) else f"{type(error).__name__}: {text}"
