"""Values of the policy far from the path, found by a process while the robot drives."""

import contextlib
import pickle
import subprocess
import sys
import threading
import time as steady
from collections.abc import Callable

from rclpy.exceptions import InvalidHandle
from rclpy.node import Node

from adp_path_follower.core.control import value_store
from adp_path_follower.core.control.far_from_path import missing_values, without_values
from adp_path_follower.core.control.value_iteration import ValueProblem
from adp_path_follower.core.settings.groups import Settings

_COMMAND = [sys.executable, "-m", value_store.__name__]


class FarValues:
    """Lets `wide_region: approach` stand for `value_grid` until the values are found."""

    def __init__(
        self,
        node: Node,
        settings: Callable[[], Settings],
        prepare: Callable[[Settings], Callable[[], None]],
    ) -> None:
        """Take the node's settings, and what prepares to go on with some."""
        self._log, self._settings, self._prepare = node.get_logger(), settings, prepare
        self._ready = node.create_guard_condition(self._look)
        self._process: subprocess.Popen[bytes] | None = None
        self._problem: ValueProblem | None = None  # that it is at, or that it failed at
        self._begun = 0.0  # steady time [s]
        node.context.on_shutdown(self._end)

    def drivable(self, wanted: Settings) -> Settings:
        """Return settings to drive with, where some are wanted; begin to find what is missing."""
        missing = missing_values(wanted)
        if not missing:
            return wanted
        if self._problem not in missing:
            self._begin(missing[0])
        return without_values(wanted)

    def _begin(self, problem: ValueProblem) -> None:
        self._end()
        self._problem = problem
        try:
            # Ctrl-C in a terminal is for the node, which ends this process.
            process = subprocess.Popen(  # noqa: S603  # our own module
                _COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
            )
        except OSError as error:
            self._warn(f"its process cannot be started ({error})")
            return
        if not self._begun:
            self._begun = steady.monotonic()
        self._process = process
        threading.Thread(target=self._wait, args=(process, problem), daemon=True).start()

    def _wait(self, process: subprocess.Popen[bytes], problem: ValueProblem) -> None:
        """Keep what a process finds, and wake the node."""
        assert process.stdin is not None
        assert process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(pickle.dumps(problem))
            process.stdin.flush()  # it stays open: the process ends when it is closed
        content = process.stdout.read()
        process.wait()
        if process is not self._process:
            return
        if process.returncode == 0:
            value_store.keep(problem, content)
        with contextlib.suppress(InvalidHandle):
            self._ready.trigger()

    def _look(self) -> None:
        """Go on to the next problem, or let the driver take over the values."""
        missing = missing_values(self._settings())
        if self._problem in missing:
            assert self._process is not None  # it was started
            self._warn(f"its process has ended (exit code {self._process.returncode})")
        elif missing:
            self._begin(missing[0])
        else:
            elapsed, self._begun = steady.monotonic() - self._begun, 0.0
            self._prepare(self._settings())()
            self._log.info(f"the policy far from the path is ready, after {elapsed:.1f} s")

    def _warn(self, text: str) -> None:
        self._log.warning(
            f"the policy far from the path cannot be found: {text}; 'approach' drives there until "
            "the settings change"
        )

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
