"""Run a node until it is asked to stop, and let it publish its last messages."""

import sys
import time as steady
from collections.abc import Callable
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from adp_path_follower.core.errors import AdpError, SettingsError
from adp_path_follower.ros.runtime.executor import executor_of
from adp_path_follower.ros.runtime.log_output import unblocked_stderr
from adp_path_follower.ros.runtime.stop_request import StopRequest


class Ending:
    """How most nodes end: at once, unless they override this; `run_node` needs it."""

    finished = False  # whether the node has nothing more to do
    failed = False  # whether that is because of an error that it has logged

    def lingers(self, elapsed: float) -> bool:
        """Return whether to go on for now, so long [s] after the node should have ended."""
        return False

    def last_words(self) -> None:
        """Publish the last messages before the node goes; called once, also after an error."""


@unblocked_stderr()
def run_node(name: str, make_node: Callable[[], Node]) -> int:
    """Spin a node to its end; return 0, 1 after a logged error, 2 for rejected settings."""
    stop = StopRequest()
    try:
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rcl raises several types for arguments that it cannot parse
        print(f"{name}: {_one_line(error)}", file=sys.stderr)
        return 2
    code = 0
    node: Any = None
    try:
        node = _made(make_node)
        try:
            _spin(node, stop)
        finally:
            if rclpy.ok():
                node.last_words()  # before anything else that takes time, as logging does
        code = int(node.failed)
        if stop.orphaned:
            get_logger(name).warning(
                "the process that started this node has ended, and so does the node: start it with "
                "nohup or setsid to outlive its parent"
            )
    except ExternalShutdownException:
        pass
    except AdpError as error:
        get_logger(name).fatal(_one_line(error))
        code = 2 if node is None else 1
    except Exception as error:  # the robot must be stopped after any error
        get_logger(name).fatal(f"unexpected error, stopping: {_one_line(error)}")
        code = 1
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
        stop.ignore_more()
    return code


def _spin(node: Any, stop: StopRequest) -> None:
    """Let the node work until it is asked to stop or is finished, and for as long as it lingers."""
    executor = executor_of(node)
    while not stop.received and not node.finished and rclpy.ok():
        executor.spin_once(timeout_sec=0.1)
    end = steady.monotonic()
    while node.lingers(steady.monotonic() - end) and rclpy.ok():
        executor.spin_once(timeout_sec=0.05)


def _made(make_node: Callable[[], Node]) -> Node:
    """Return the node; raise AdpError if it or rclpy rejected its settings."""
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
