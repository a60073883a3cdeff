"""Start nodes as processes on a DDS domain of their own, and end all of them."""

import contextlib
import fcntl
import os
import random
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path as FilePath

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.settings.schema import Value, yaml_text

_DOMAINS = range(1, 102)  # the ports of higher ones lie where Linux takes ports for clients


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """Claim a ROS domain that no other run on this machine has; raise AdpError if all are taken."""
    candidates = list(_DOMAINS)
    random.shuffle(candidates)
    for domain in candidates:
        file = FilePath(tempfile.gettempdir()) / f"adp_path_follower_domain_{domain}.lock"
        with file.open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield domain
            return
    raise AdpError("every ROS domain from 1 to 101 is taken: end other runs first")


class NodeProcess:
    """One node of this package as a process in a process group of its own."""

    def __init__(
        self,
        executable: str,
        parameters: Mapping[str, Value],
        *,
        log: FilePath,
        domain: int,
        arguments: tuple[str, ...] = (),
    ) -> None:
        """Start "controller", "sim_unicycle", "path_publisher" or "recorder" in a ROS domain.

        `log` gets the node's output; `arguments` follow after ``--ros-args`` and the parameters.
        """
        self.name = executable
        self.log = log
        environment = {
            **os.environ,
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }
        settings = [
            part
            for name, value in parameters.items()
            for part in ("-p", f"{name}:={yaml_text(value)}")
        ]
        command = [sys.executable, "-m", "adp_path_follower.ros.runtime.entry", executable]
        with log.open("wb") as output:
            self.process = subprocess.Popen(  # noqa: S603  # our own executable
                [*command, "--ros-args", *settings, *arguments],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                process_group=0,  # not a session, in which a node outlives its parent
            )

    def output(self) -> str:
        """Return what the node has printed so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def last_line(self) -> str:
        """Return the last line that the node printed."""
        lines = self.output().strip().splitlines()
        return lines[-1] if lines else f"exit code {self.process.poll()}"

    def stop(self, number: int = signal.SIGINT, timeout: float = 10.0) -> int:
        """Ask the node to end, kill its group if it does not, and return its exit code."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, number)
            try:
                self.process.wait(timeout)
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, signal.SIGKILL)
        return self.process.wait()
