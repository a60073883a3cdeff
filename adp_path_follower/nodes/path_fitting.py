"""From the bytes of a path to a route, in a process of its own.

Python's threads share one interpreter: a path of a hundred thousand poses, fitted in a thread,
makes control steps wait for tens of milliseconds (`bench/paths.py`). A process does not. It is a
fork of the node before that has any thread or any of its own imports, and imports what paths are
fitted with (scipy's splines) while the node starts beside it: the node does without.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import pickle
import signal
import socket
import sys
from collections.abc import Callable
from types import TracebackType
from typing import Any

import numpy as np

from adp_path_follower.bags.cdr import CdrError
from adp_path_follower.bags.raw_messages import read_path, transformed
from adp_path_follower.core.errors import AdpError, PathError
from adp_path_follower.core.route import Route
from adp_path_follower.core.settings import PathSettings
from adp_path_follower.nodes.stop_request import ending_signals

_NICE = 5  # control comes first, where there are fewer cores than processes

REFUSALS = (AdpError, CdrError)

# From the bytes of a nav_msgs/Path, the transform of its frame and settings to a route.
Fit = Callable[[bytes, tuple[float, ...], PathSettings], Route]


def route_of_message(raw: bytes, transform: tuple[float, ...], settings: PathSettings) -> Route:
    """Return the route of a path, ready to be driven.

    Args:
        raw: A serialised nav_msgs/Path.
        transform: x [m], y [m], turn [rad] of its frame in that of the route; empty if they are
            the same.
        settings: What to prepare it with.

    Raises:
        AdpError: The path cannot be driven.
        CdrError: The bytes are no path.

    """
    from adp_path_follower.core.path_preparation import prepare

    poses = transformed(read_path(raw).poses, transform)
    route = prepare(poses[:, :2], settings, poses[:, 2])
    route.make_ready()
    return route


def reason(error: Exception) -> str:
    """Return why a path is refused, as a sentence."""
    return f"path cannot be read: {error}" if isinstance(error, CdrError) else str(error)


class FittingProcess:
    """Answers what `route_of_message` answers, as long as it lives; without it, so does the caller.

    To be made before the process has threads, as these are not there in a fork, but their locks
    are.
    """

    def __init__(self) -> None:
        """Start the process; where the machine has none to give, do without."""
        ours, theirs = socket.socketpair()
        self._connection: socket.socket | None = ours
        self._over = False
        fork = multiprocessing.get_context("fork")
        self._process = fork.Process(target=_serve, args=(theirs, ours), daemon=True)
        try:
            self._process.start()
        except OSError as error:
            self._do_without(f"cannot be started ({error})")
        theirs.close()

    @property
    def pid(self) -> int:
        """Return the number of the process."""
        assert self._process.pid is not None  # it was started
        return self._process.pid

    def __enter__(self) -> FittingProcess:
        """Return the running process."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """End it, whatever it is at, and the thread that waits for its answer."""
        self._over = True
        if self._process.pid is not None:
            self._process.kill()
            self._process.join()

    def route(self, raw: bytes, transform: tuple[float, ...], settings: PathSettings) -> Route:
        """Return the route of a path; see `route_of_message`.

        Raises:
            SystemExit: The process was told to end meanwhile.

        """
        found: Route | str | None = None
        if self._connection is not None:
            try:
                _send(self._connection, (raw, transform, settings))
                found = _receive(self._connection)
            except (EOFError, OSError):
                if self._over:
                    sys.exit()  # ends this thread
                self._do_without("has ended")
        if found is None:
            return route_of_message(raw, transform, settings)
        if isinstance(found, str):
            raise PathError(found)
        return found

    def _do_without(self, why: str) -> None:
        from rclpy.logging import get_logger  # here, so that a fork needs no more than numpy

        self._connection = None
        get_logger("path_fitting").warning(
            f"the process that prepares paths {why}: control steps may come late while the node "
            "prepares a long path itself; restart the node when that suits"
        )


def _serve(connection: socket.socket, others: socket.socket) -> None:
    """Answer until the node is gone."""
    others.close()  # else this process would never see that the node is gone
    for number in ending_signals():  # Ctrl-C is for the node, which ends this process
        signal.signal(number, signal.SIG_IGN)
    importlib.import_module("adp_path_follower.core.path_preparation")  # before the first path
    os.nice(_NICE)
    with contextlib.suppress(EOFError, OSError):
        while True:
            raw, transform, settings = _receive(connection)
            answer: Route | str
            try:
                answer = route_of_message(raw, transform, settings)
            except REFUSALS as error:
                answer = reason(error)
            _send(connection, answer)


# A long route has 30 MB. Arrays go through the socket as they are, and are read where they stay:
# nothing of that keeps a control step waiting, as unpickling all of it would.


def _send(connection: socket.socket, content: object) -> None:
    """Send an object to the other process."""
    arrays: list[pickle.PickleBuffer] = []
    rest = pickle.dumps(content, protocol=5, buffer_callback=arrays.append)
    parts = [memoryview(rest), *(array.raw() for array in arrays)]
    sizes = np.array([part.nbytes for part in parts])
    for part in (np.array([len(parts)]).data, sizes.data, *parts):
        connection.sendall(part)


def _receive(connection: socket.socket) -> Any:
    """Return an object of the other process.

    Raises:
        EOFError: It has ended.

    """
    (count,) = _read(connection, 8).view(int)
    sizes = _read(connection, 8 * count).view(int)
    rest, *arrays = (_read(connection, size) for size in sizes.tolist())
    return pickle.loads(rest.data, buffers=arrays)  # noqa: S301  # written by our own fork


def _read(connection: socket.socket, size: int) -> np.ndarray:
    """Return so many bytes as they come, shape (size,)."""
    found = np.empty(size, np.uint8)
    rest = found.data
    while rest:
        count = connection.recv_into(rest)
        if not count:
            raise EOFError
        rest = rest[count:]
    return found
