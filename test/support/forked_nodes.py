"""Start nodes as forks of one process that has imported them.

A node needs most of a second of processor time to import numpy, scipy, rclpy and the core; a fork
has them. All else is as in a process of its own: the entry point of the executable, its arguments,
environment, signals, process group and exit code. Other tests start each node as a new Python.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import importlib
import inspect
import itertools
import json
import os
import re
import resource
import runpy
import select
import signal
import socket
import subprocess
import sys
import warnings
from pathlib import Path as FilePath
from typing import Any

_ENTRY = "adp_path_follower.ros.runtime.entry"
_STARTED_BY = "adp_path_follower.ros.runtime.stop_request"
_PRELOADED = (
    "adp_path_follower.core.driving.driver",
    "adp_path_follower.core.path.preparation",
    "adp_path_follower.core.learning.weights_file",
    "adp_path_follower.ros.controller.node",
    "adp_path_follower.ros.controller.path_process",
    "adp_path_follower.ros.path_publisher",
    "adp_path_follower.ros.recorder.node",
    "sim_unicycle.node",
)


class ForkedProcess:
    """A fork of the server: the part of `subprocess.Popen` that tests use."""

    def __init__(self, server: NodeServer, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._server = server
        self._end = os.pidfd_open(pid)

    def poll(self) -> int | None:
        """Return the exit code, or None while the process runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the end of the process and return its exit code.

        Raises:
            subprocess.TimeoutExpired: It still runs after the timeout [s].

        """
        if self.returncode is None:
            if not select.select([self._end], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired("node", timeout or 0.0)
            self.returncode = self._server.ask(reap=self.pid)
            os.close(self._end)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal, unless the process has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)


class NodeServer:
    """The process that is forked; it ends when its maker closes it or ends."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, __file__], stdin=theirs, process_group=0
            )
        self._ours, self._answers = ours, ours.makefile("r")

    def ask(self, **request: Any) -> int:
        """Return the number that the server answers a request with."""
        self._ours.sendall(json.dumps(request).encode() + b"\n")
        answer = self._answers.readline()
        assert answer, "the server of nodes has ended"
        return int(answer)

    def start(
        self, arguments: list[str], environment: dict[str, str], log: FilePath, *, script: str = ""
    ) -> ForkedProcess:
        """Start a node of the package, or a Python script, and return the process.

        Args:
            arguments: The arguments of ``python -m adp_path_follower.ros.runtime.entry``.
            environment: The environment.
            log: File for what it prints.
            script: Python text to run instead of a node.

        """
        log.write_bytes(b"")  # now: who reads it may come before the fork writes
        pid = self.ask(
            arguments=arguments,
            environment=environment,
            log=str(log),
            script=script,
            folder=os.getcwd(),
            file_size=resource.getrlimit(resource.RLIMIT_FSIZE),
        )
        return ForkedProcess(self, pid)

    def close(self) -> None:
        """End the server."""
        self._answers.close()
        self._ours.close()
        self._process.wait()


def forked_node(
    server: NodeServer,
    executable: str,
    parameters: dict[str, Any],
    log: FilePath,
    domain: int,
    arguments: tuple[str, ...] = (),
) -> Any:
    """Return a node of the package as a fork of the server; see `NodeProcess`."""
    from adp_path_follower.core.settings.schema import yaml_text
    from adp_path_follower.study.demo import NodeProcess

    class ForkedNode(NodeProcess):
        """A node that a server has started."""

        def __init__(self) -> None:  # all of its own: nothing of NodeProcess starts a process
            self.name, self.log = executable, log
            settings = (("-p", f"{name}:={yaml_text(value)}") for name, value in parameters.items())
            self.process = server.start(
                [executable, "--ros-args", *itertools.chain(*settings), *arguments],
                {**os.environ, "ROS_DOMAIN_ID": str(domain)},
                log,
            )

        def stop(self, number: int = signal.SIGINT, timeout: float = 60.0) -> int:
            return super().stop(number, timeout)

    return ForkedNode()


def _preload() -> None:
    from adp_path_follower.threads import use_one_blas_thread

    use_one_blas_thread()
    for name in _PRELOADED:
        importlib.import_module(name)
    # Each type's conversions are libraries that are opened when they are first needed.
    for module in [module for name, module in sys.modules.items() if "_msgs." in name]:
        for kind in vars(module).values():
            if getattr(type(kind), "_TYPE_SUPPORT", 0) is None:
                type(kind).__import_type_support__()
    # rclpy asks for it at a node's first line of log, and it looks at the file of each module.
    inspect.getmodule(inspect.currentframe())
    _let_tracer_fork()
    gc.collect()
    gc.freeze()


def _let_tracer_fork() -> None:
    """Tell the tracer that rclpy loads of each fork, in which it needs its two threads anew."""
    maps = FilePath("/proc/self/maps").read_text()
    found = re.search(r"\S+/liblttng-ust(-[0-9a-f]+)?\.so\.\S+", maps)
    assert len(os.listdir("/proc/self/task")) == 1 + 2 * (found is not None)
    if found is not None:
        library, signals = ctypes.CDLL(found.group()), ctypes.create_string_buffer(128)
        prefix = "lttng_ust" if hasattr(library, "lttng_ust_before_fork") else "ust"
        before, parent, child = (
            functools.partial(getattr(library, f"{prefix}_{name}"), signals)
            for name in ("before_fork", "after_fork_parent", "after_fork_child")
        )
        os.register_at_fork(before=before, after_in_parent=parent, after_in_child=child)


def _serve() -> dict[str, Any]:
    """Answer requests until there are no more; return, in a fork only, what to run there."""
    connection = socket.socket(fileno=os.dup(0))
    for line in connection.makefile("r"):
        request = json.loads(line)
        if "reap" in request:
            _, status = os.waitpid(request["reap"], 0)
            answer = os.waitstatus_to_exitcode(status)
        else:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about the threads
                answer = os.fork()
            if answer == 0:
                connection.close()
                return request
            os.setpgid(answer, answer)  # here and in the fork: whoever comes first
        connection.sendall(f"{answer}\n".encode())
    os._exit(0)


def _become(request: dict[str, Any]) -> None:
    """Take over what a process of its own would have been started with."""
    os.setpgid(0, 0)
    nothing = os.open(os.devnull, os.O_RDONLY)
    output = os.open(request["log"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    for source, target in ((nothing, 0), (output, 1), (output, 2)):
        os.dup2(source, target)
    os.closerange(3, 256)
    os.environ.clear()
    os.environ.update(request["environment"])
    folders = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    sys.path[:0] = [folder for folder in folders if folder and folder not in sys.path]
    os.chdir(request["folder"])
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whoever runs the tests may ignore it (nohup)
    resource.setrlimit(resource.RLIMIT_FSIZE, tuple(request["file_size"]))
    importlib.reload(sys.modules[_STARTED_BY])  # it looks at its process when it is imported
    sys.argv = [_ENTRY, *request["arguments"]]


def _main() -> None:
    _preload()
    request = _serve()
    _become(request)
    if request["script"]:
        sys.argv = ["-c"]
        exec(compile(request["script"], "<string>", "exec"), {"__name__": "__main__"})  # noqa: S102
    else:
        runpy.run_module(_ENTRY, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    _main()
