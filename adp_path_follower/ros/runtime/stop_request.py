"""Requests to end a node: a signal, or the death of the process that started it."""

import os
import signal
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
# Read at the import, before the half second that rclpy's takes.
_PARENT = os.getppid()
_HANG_UP_IGNORED = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


def ending_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that end a node in good order: not kill -9, nor SIGHUP under nohup."""
    return tuple(
        number for number in _SIGNALS if number is not signal.SIGHUP or not _HANG_UP_IGNORED
    )


class StopRequest:
    """Remember signals, and notice the death of the parent.

    rclpy's own handlers shut the context down at once, before the robot is told to stop. The parent
    is polled: Linux's signal (PR_SET_PDEATHSIG) comes when the thread that started the node ends.
    """

    def __init__(self) -> None:
        self._signalled = False
        # nohup (ignores SIGHUP), setsid and systemd (make sessions) start nodes that outlive their
        # parent; `ros2 launch` leaves its nodes.
        self._outlives = _HANG_UP_IGNORED or os.getsid(0) == os.getpid() or _PARENT <= 1
        for number in ending_signals():
            signal.signal(number, self._receive)

    @property
    def received(self) -> bool:
        """Return whether the node must end."""
        return self._signalled or self.orphaned

    @property
    def orphaned(self) -> bool:
        """Return whether the process that started the node has ended."""
        return not self._outlives and os.getppid() != _PARENT

    def ignore_more(self) -> None:
        """Ignore signals from now on: one while Python finalises would change the exit code."""
        for number in ending_signals():
            signal.signal(number, signal.SIG_IGN)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self._signalled = True
