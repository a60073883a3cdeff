"""Ctrl-C that is not lost, wherever it comes."""

from __future__ import annotations

import signal
import threading
from types import FrameType, TracebackType
from typing import Any


class Interrupts:
    """Notes SIGINT while it raises it.

    Python ignores what is raised in a destructor, and Dask's futures have long ones: without the
    note an interrupt there would be no more than a line of warning, and the work go on.
    """

    def __init__(self) -> None:
        """Begin with none."""
        self._received = False
        self._before: Any = None

    def __enter__(self) -> Interrupts:
        """Take over, in the main thread: others are never interrupted."""
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._receive)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Leave SIGINT to whoever had it."""
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if there was one."""
        if self._received:
            raise KeyboardInterrupt

    def _receive(self, number: int, frame: FrameType | None) -> None:
        self._received = True
        raise KeyboardInterrupt
