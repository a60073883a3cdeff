"""The log of a node, which must never hold the node up."""

import contextlib
import fcntl
import os
import sys
import threading
from collections.abc import Iterator

_ROOM = 1 << 20  # bytes of log that wait for their reader; further ones are lost
_PATIENCE = 1.0  # [s] at the end, for a reader that stalls


@contextlib.contextmanager
def unblocked_stderr() -> Iterator[None]:
    """Let a thread pass on what is written to stderr, so that the node never waits for its reader.

    A terminal after Ctrl-S or a launcher that hangs reads no more. When the pipe to it is full, the
    node that logs waits, and rclpy holds Python's lock meanwhile: no thread could stop the robot.
    """
    descriptor = sys.__stderr__.fileno() if sys.__stderr__ is not None else 2
    try:
        original = os.dup(descriptor)
    except OSError:  # there is no stderr
        yield
        return
    if os.isatty(original):  # rcutils would see a pipe
        os.environ.setdefault("RCUTILS_COLORIZED_OUTPUT", "1")
    reader, writer = os.pipe()
    with contextlib.suppress(OSError):  # the system's limit: then the usual size must do
        fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, _ROOM)
    os.set_blocking(writer, False)
    os.dup2(writer, descriptor)
    os.close(writer)
    thread = threading.Thread(target=_pass_on, args=(reader, original), daemon=True)
    thread.start()
    try:
        yield
    finally:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, descriptor)  # closes the pipe, which ends the thread
        os.close(nowhere)
        thread.join(_PATIENCE)
        if not thread.is_alive():  # else a message at the very end would wait for the reader
            os.dup2(original, descriptor)


def _pass_on(reader: int, original: int) -> None:
    """Copy a pipe to stderr, until its other end is closed or stderr cannot be written."""
    with contextlib.suppress(OSError):
        while data := os.read(reader, 1 << 16):
            while data:
                data = data[os.write(original, data) :]
