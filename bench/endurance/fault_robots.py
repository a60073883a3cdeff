"""Start moving robots with their nodes, as targets of faults."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path as FilePath
from typing import Any

sys.path.insert(0, str(FilePath(__file__).resolve().parents[2] / "test" / "support"))
sys.path.insert(0, str(FilePath(__file__).resolve().parents[2] / "test" / "ros" / "controller"))

# The tests' nodes, and a peer on their domain.
from geometry_msgs.msg import TwistStamped

from adp_path_follower.study.demo import NodeProcess
from live_nodes import Drive, Peer, is_zero, launched  # after the path


class Bench:
    """Controllers on a domain of their own."""

    def __init__(self, domain: int, folder: FilePath, only: str) -> None:
        """Take the domain, a folder for logs, and a part of the names of faults that are wanted."""
        self._domain, self._folder, self._only = domain, folder, only
        self._numbers = itertools.count()

    def wanted(self, *names: str) -> bool:
        """Return whether one of these faults is to be measured."""
        return any(self._only in name for name in names)

    @contextlib.contextmanager
    def nodes(self) -> Iterator[tuple[Peer, Callable[..., NodeProcess]]]:
        """Yield a peer, and a function that starts nodes, which end with the block."""
        peer, nodes = Peer(self._domain), []

        def start(executable: str, **values: Any) -> NodeProcess:
            log = self._folder / f"{next(self._numbers)}.log"
            nodes.append(NodeProcess(executable, values, log=log, domain=self._domain))
            return nodes[-1]

        try:
            yield peer, start
        finally:
            peer.close()
            for node in nodes:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(node.process.pid, signal.SIGCONT)
                node.stop()

    @contextlib.contextmanager
    def drive(self, **parameters: Any) -> Iterator[Drive]:
        """Yield a robot that moves."""
        with self.nodes() as (peer, start):
            yield Drive(peer, start, **parameters)

    @contextlib.contextmanager
    def orphan(self) -> Iterator[tuple[Drive, subprocess.Popen[bytes]]]:
        """Yield a robot that moves, and the process that launched its controller."""
        peer = Peer(self._domain)
        try:
            log = self._folder / f"{next(self._numbers)}.log"
            with launched(peer, self._domain, log) as (drive, launcher, _):
                yield drive, launcher
        finally:
            peer.close()

    @contextlib.contextmanager
    def defective(self, code: str) -> Iterator[Peer]:
        """Yield a peer that feeds a controller with a defect after 50 steps."""
        peer = Peer(self._domain)
        with subprocess.Popen(  # noqa: S603  # our own code
            [sys.executable, "-c", code],
            env={**os.environ, "ROS_DOMAIN_ID": str(self._domain)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as process:
            try:
                peer.until_matched(peer.odometry, peer.path)
                yield peer
            finally:
                process.kill()
                peer.close()


class Alternating:
    """Makes every second message of a drive's odometry wrong."""

    def __init__(self, drive: Drive) -> None:
        """Take the drive."""
        self._drive, self._wrong = drive, False
        self._timer: Any = None

    def begin(self) -> None:
        """Send wrong odometry at once, then sound, then wrong odometry, and so on."""
        self._drive.odometry = None
        self._wrong = False
        self._send()
        self._timer = self._drive.peer.node.create_timer(0.02, self._send)

    def end(self) -> None:
        """Send nothing but sound odometry."""
        self._drive.peer.node.destroy_timer(self._timer)
        self._drive.odometry = {}

    def _send(self) -> None:
        self._wrong = not self._wrong
        self._drive.peer.send_odometry(
            (0.0, 0.1, 0.0), **({"x": float("nan")} if self._wrong else {})
        )


def from_last_motion(peer: Peer, inject: Callable[[Peer], None] | None = None) -> float:
    """Return the time from the last command to move until zero velocity [s].

    A defect that does not come by itself is injected after some motion.
    """
    last = time.monotonic()
    stopped = 0.0

    def take(command: TwistStamped) -> None:
        nonlocal last, stopped
        if not is_zero(command):
            last = time.monotonic()
        elif moved():
            stopped = stopped or time.monotonic()

    begun = last

    def moved() -> bool:
        return last > begun

    peer.node.create_subscription(TwistStamped, "cmd_vel", take, 100)
    peer.send_path()
    peer.node.create_timer(0.02, lambda: peer.send_odometry((0.0, 0.1, 0.0)))
    if inject is not None:
        peer.until(moved, "motion")
        peer.pause(0.5)
        inject(peer)
    peer.until(lambda: stopped, "zero velocity")
    return stopped - last
