"""Measure the time from a fault to zero velocity, with real processes over real DDS.

    python bench/faults.py [--runs 20] [--json FILE]

A controller follows a line; the fault is injected again and again, each time after it has been
seen to move the robot. Time is from the injection until a command of zero velocity is received, so
it holds what DDS and a busy machine add, and the timeout where a timeout is what finds the fault.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "test" / "nodes"))

# What the tests have for nodes, a peer on their domain and a defective controller.
from conftest import Drive, Peer, is_zero  # after the path
from nav_msgs.msg import Path as PathMessage
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from test_controller_node import BROKEN_CONTROLLER
from test_safety import HANGING_CONTROLLER

from adp_path_follower.nodes.processes import NodeProcess, own_domain

NAN, INFINITE = float("nan"), float("inf")
ODOMETRY = {
    "odometry is not a number": {"x": NAN},
    "odometry is infinite": {"y": INFINITE},
    "orientation of zero norm": {"qw": 0.0, "qz": 0.0},
    "odometry is 1 s old by its stamp": {"later": -1.0},
    "odometry of another robot frame": {"child_frame_id": "other"},
    "odometry jumps by 3 m": {"x": 3.0},
    "odometry turns by half a turn": {"qz": 1.0, "qw": 0.0},
}


class Bench:
    """Controllers on a domain of their own."""

    def __init__(self, domain: int, folder: Path) -> None:
        """Take the domain and a folder for logs."""
        self._domain, self._folder = domain, folder
        self._numbers = itertools.count()

    @contextlib.contextmanager
    def drive(self, **parameters: Any) -> Iterator[Drive]:
        """Yield a robot that moves."""
        peer, nodes = Peer(self._domain), []

        def start(executable: str, **values: Any) -> NodeProcess:
            log = self._folder / f"{next(self._numbers)}.log"
            nodes.append(NodeProcess(executable, values, log=log, domain=self._domain))
            return nodes[-1]

        try:
            yield Drive(peer, start, **parameters)
        finally:
            peer.close()
            for node in nodes:
                node.stop()

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


def until_zero(peer: Peer, commands: list[Any], since: float) -> float:
    """Return the time since a moment until a command of zero velocity comes [s]."""
    seen = len(commands)
    peer.until(lambda: any(map(is_zero, commands[seen:])), "zero velocity")
    return time.monotonic() - since


def injected(
    drive: Drive, inject: Callable[[], None], repair: Callable[[], None], runs: int
) -> list[float]:
    """Return the times to zero velocity of faults that a running controller recovers from."""
    times = []
    for run in range(runs):
        drive.until_moving()
        drive.peer.spin(0.3 + 0.0037 * run)  # at another moment of the period each time
        begun = time.monotonic()
        inject()
        times.append(until_zero(drive.peer, drive.commands, begun))
        repair()
    return times


def recoverable(bench: Bench, runs: int) -> Iterator[tuple[str, list[float]]]:
    """Yield each fault that the controller recovers from, with its times."""
    with bench.drive() as drive:
        peer = drive.peer

        def feed(values: dict[str, Any] | None) -> None:
            drive.odometry = values
            if values is not None:
                drive._send()  # at once, not with the next period of the test's timer

        for name, values in ODOMETRY.items():
            yield (
                name,
                injected(drive, lambda values=values: feed(dict(values)), lambda: feed({}), runs),
            )

        yield (
            "odometry ends (timeout 0.5 s)",
            injected(drive, lambda: feed(None), lambda: feed({}), runs),
        )
        empty = PathMessage(header=Header(frame_id="odom"))
        yield (
            "an empty path",
            injected(
                drive, lambda: peer.path.publish(empty), lambda: peer.send_path() and None, runs
            ),
        )
        stop = peer.node.create_client(Trigger, "path_follower/stop")
        yield (
            "~/stop",
            injected(
                drive,
                lambda: stop.call_async(Trigger.Request()) and None,
                lambda: peer.call(Trigger, "path_follower/resume") and None,
                runs,
            ),
        )

        def back_on_the_path() -> None:
            feed({})
            peer.spin(0.3)
            peer.call(Trigger, "path_follower/resume")

        peer.set_parameter("path_follower", "max_cross_track_error", 0.15)
        yield (
            "max_cross_track_error",
            injected(drive, lambda: feed({"y": 0.2}), back_on_the_path, runs),
        )


def final(bench: Bench, runs: int) -> Iterator[tuple[str, list[float]]]:
    """Yield each fault that ends the controller, or a step of it, with its times."""
    for number in (signal.SIGINT, signal.SIGTERM):
        times = []
        for _ in range(runs):
            with bench.drive() as drive:
                begun = time.monotonic()
                os.killpg(drive.controller.process.pid, number)
                times.append(until_zero(drive.peer, drive.commands, begun))
        yield number.name, times
    defects = {
        "an exception in a callback": BROKEN_CONTROLLER,
        "a control step that hangs (timeout 0.5 s)": HANGING_CONTROLLER,
    }
    for name, code in defects.items():
        times = []
        for _ in range(runs):
            with bench.defective(code) as peer:
                times.append(_from_last_motion(peer))
        yield name, times


def _from_last_motion(peer: Peer) -> float:
    """Return the time from the last command to move until zero velocity [s]."""
    from geometry_msgs.msg import TwistStamped

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
    peer.until(lambda: stopped, "zero velocity")
    return stopped - last


def main() -> None:
    """Print the table, and write it if asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20, help="of each fault (default: 20)")
    parser.add_argument("--json", type=Path, help="write the times [s] here")
    arguments = parser.parse_args()
    found = {}
    print(f"{'fault':<44}{'median':>10}{'worst':>10}   time to zero velocity [ms]")
    with own_domain() as domain, tempfile.TemporaryDirectory() as folder:
        bench = Bench(domain, Path(folder))
        for name, times in itertools.chain(
            recoverable(bench, arguments.runs), final(bench, arguments.runs)
        ):
            found[name] = sorted(times)
            median = 1e3 * found[name][len(times) // 2]
            print(f"{name:<44}{median:10.0f}{1e3 * max(times):10.0f}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
