"""From the bytes of a path to a route, in a process of its own.

A path of a hundred thousand poses, fitted in a thread, makes control steps wait for tens of
milliseconds (`bench/speed/paths.py`). A process does not, and its end costs a path, not the robot.
It is a fork of the node before that has threads, and imports scipy's splines while the node starts.
One that replaces it is a new Python: a fork would have the locks of the node's threads.
"""

import contextlib
import importlib
import os
import pickle
import signal
import socket
import sys
import threading
from collections.abc import Callable
from multiprocessing.context import ForkContext, SpawnContext
from multiprocessing.process import BaseProcess
from typing import Any

import numpy as np

from adp_path_follower.core.errors import AdpError, PathError
from adp_path_follower.core.path.route import Route
from adp_path_follower.core.settings.groups import PathSettings
from adp_path_follower.messages.raw import CdrError, read_path
from adp_path_follower.ros.runtime.stop_request import ending_signals

_NICE = 5  # control comes first, where there are fewer cores than processes
_PATIENCE = 20.0  # [s] without an answer: hundreds of times what a short path takes, and then
_PATIENCE_EACH = 5e-6  # [s] for each byte of it, fifty times what a long one takes

# From the bytes of a nav_msgs/Path and settings to a route, in the frame of the path.
Fit = Callable[[bytes, PathSettings], Route]


def route_of_message(raw: bytes, settings: PathSettings) -> Route:
    """Return the route of a path, a serialised nav_msgs/Path, ready to be driven.

    Raises AdpError if the path cannot be driven, CdrError if the bytes are no path.
    """
    from adp_path_follower.core.path.preparation import prepare

    poses = read_path(raw).poses
    route = prepare(poses[:, :2], settings, poses[:, 2])
    route.make_ready()
    return route


def reason(error: Exception) -> str:
    """Return why a path is rejected, as a sentence."""
    if isinstance(error, AdpError):
        return str(error)
    if isinstance(error, CdrError):
        return f"path cannot be read: {error}"
    return f"path cannot be prepared: unexpected {type(error).__name__}: {error}"


class FittingProcess:
    """Answers as `route_of_message`, in a process if it can; make it before there are threads."""

    def __init__(self) -> None:
        """Start the process; where the machine has none to give, do without."""
        self._over = False
        self._asking = threading.Lock()  # one path at a time
        self._starting = threading.Lock()  # so that none is started when all is over
        self._start(ForkContext())

    def __enter__(self) -> "FittingProcess":
        """Return the running process."""
        return self

    def __exit__(self, *error: object) -> None:
        """End it, whatever it is at, and the thread that waits for its answer."""
        with self._starting:
            self._over = True
            self._end()

    def route(self, raw: bytes, settings: PathSettings) -> Route:
        """Return the route of a path; see `route_of_message`.

        Raises PathError if it cannot be driven or read, or the process fails at it; SystemExit if
        told to end meanwhile.
        """
        with self._asking:
            if self._connection is not None and not self._process.is_alive():
                self._replace()
                _warn("has ended without a path to prepare, and was started anew")
            if self._connection is None:
                return route_of_message(raw, settings)
            found = self._answer(self._connection, (raw, settings), len(raw))
        if isinstance(found, str):
            raise PathError(found)
        return found

    def _answer(self, connection: socket.socket, request: object, size: int) -> Route | str:
        """Return the route of a path of so many bytes from the process, or why there is none."""
        patience = _PATIENCE + _PATIENCE_EACH * size
        connection.settimeout(patience)
        try:
            _send(connection, request)
            found: Route | str = _receive(connection)
        except TimeoutError:
            self._replace()
            return (
                f"path was not prepared within {patience:.0f} s: publish it again, with fewer "
                "poses if it is long"
            )
        except (EOFError, OSError):
            code = self._replace()
            return (
                f"path cannot be prepared: the process at work on it has ended (exit code {code}); "
                "publish it again, with fewer poses if memory is short"
            )
        except Exception as error:
            self._replace()  # the rest of the answer must not be taken for that to the next path
            return reason(error)
        return found

    def _replace(self) -> int | None:
        """Start another process and return the old one's exit code; SystemExit if not wanted."""
        with self._starting:
            if self._over:
                sys.exit()  # ends this thread
            code = self._end()
            if self._connection is not None:
                self._connection.close()
            self._start(SpawnContext())
            return code

    def _start(self, context: ForkContext | SpawnContext) -> None:
        ours, theirs = socket.socketpair()
        self._connection: socket.socket | None = ours
        inherited = ours if isinstance(context, ForkContext) else None
        self._process: BaseProcess = context.Process(
            target=_serve, args=(theirs, inherited), daemon=True
        )
        try:
            self._process.start()
        except OSError as error:
            self._connection = None
            _warn(
                f"cannot be started ({error}): control steps may come late while the node prepares "
                "a long path itself; restart the node when that suits"
            )
        theirs.close()

    def _end(self) -> int | None:
        """End the process, whatever it is at, and return its exit code."""
        if self._process.pid is None:
            return None
        self._process.kill()  # also if it is stopped; one that is dead keeps its exit code
        self._process.join()
        return self._process.exitcode


def _warn(text: str) -> None:
    from rclpy.logging import get_logger  # here, so that a fork needs no more than numpy

    get_logger("path_fitting").warning(f"the process that prepares paths {text}")


def _serve(connection: socket.socket, inherited: socket.socket | None) -> None:
    """Answer until the node is gone."""
    if inherited is not None:
        inherited.close()  # else this process would never see that the node is gone
    for number in ending_signals():  # Ctrl-C is for the node, which ends this process
        signal.signal(number, signal.SIG_IGN)
    importlib.import_module("adp_path_follower.core.path.preparation")  # before the first path
    os.nice(_NICE)
    with contextlib.suppress(EOFError, OSError):
        while True:
            raw, settings = _receive(connection)
            answer: Route | str
            try:
                answer = route_of_message(raw, settings)
            except Exception as error:  # whatever it is, the next path is another one
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
    """Return an object of the other process; raise EOFError if it has ended."""
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


def main() -> int:
    """Run the node with the process beside it; return the node's exit code."""
    with FittingProcess() as fitting:
        # Only now: the imports of the two processes take half a second, and go on side by side.
        from adp_path_follower.ros.controller.node import NODE_NAME, PathFollowerNode
        from adp_path_follower.ros.runtime.run import run_node

        return run_node(NODE_NAME, lambda: PathFollowerNode(fitting.route))
