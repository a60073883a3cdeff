"""Ctrl-C that is not lost, wherever it comes."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType


@contextlib.contextmanager
def noted_interrupts() -> Iterator[Callable[[], None]]:
    """Note SIGINT while it raises `KeyboardInterrupt`; yield what raises it again if there was one.

    Python ignores what is raised in a destructor, and Dask's futures have long ones: without the
    note an interrupt there would be no more than a line of warning, and the work go on. Only the
    main thread is ever interrupted.
    """
    received = False

    def receive(number: int, frame: FrameType | None) -> None:
        nonlocal received
        received = True
        raise KeyboardInterrupt

    def check() -> None:
        if received:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield check
        return
    before = signal.signal(signal.SIGINT, receive)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
