"""Measure the controller node against rclpy relays of the same messages, in turns.

    python bench/speed/node.py [--seconds 10] [--rounds 3] [--memory 600] [--json FILE]

One relay is bare, one is loaded with the controller's services, subscriptions and watch. Relays
and controllers are processes on DDS domains of their own. The bench sends odometry at 20, 50,
100 and 200 Hz to one after the other, of a robot that drives on a circle as it is told, and waits
for the command that answers it (`control_trigger: odometry`). Processor time is that of the process
while it is its turn; latency is from before a message is published until its command was received.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path as FilePath
from typing import Any

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
    FilePath(__file__).parents[1] / "quick_discovery.xml"
)

import numpy as np
import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from timing import Row, arguments, report

from adp_path_follower.core.geometry import FloatArray, advance_pose
from adp_path_follower.core.path.library import circle
from adp_path_follower.ros.runtime.conversions import (
    odometry_message,
    poses_message,
    stamp_nanoseconds,
)
from adp_path_follower.study.demo import NodeProcess, own_domain

_RATES = (20.0, 50.0, 100.0, 200.0)
_CONTROLLER = {"control_trigger": "odometry", "path_start": "beginning"}
_WARM_UP = 1200  # messages: the first 1000 steps are told to those who may join late
_PATIENCE = 60.0  # [s]
_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE = os.sysconf("SC_PAGE_SIZE")


class Contender:
    """A node under test in its own process, with its peer."""

    def __init__(self, name: str, domain: int, folder: FilePath) -> None:
        """Start one of `CONTENDERS`."""
        self.name = name
        self._context = rclpy.Context()
        self._context.init(domain_id=domain)
        self._node = rclpy.create_node(f"bench_{domain}", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._odometry = self._node.create_publisher(Odometry, "odom", 10)
        self._path = self._node.create_publisher(PathMessage, "path", latched)
        self._route = poses_message(circle(0.5).points(0.05), "odom", 0)
        self._node.create_subscription(TwistStamped, "cmd_vel", self._receive, 10)
        self._sent: dict[int, float] = {}
        self.latency: list[float] = []
        self.moved = False
        self._pose: FloatArray = np.array([0.0, -0.1, 0.1])
        self._twist = (0.0, 0.0)
        self._log = folder / f"{name}_{time.monotonic_ns()}.log"
        self._begun = time.perf_counter()
        self.process = self._start(domain, CONTENDERS[name])

    def _start(
        self, domain: int, what: dict[str, Any] | str
    ) -> subprocess.Popen[bytes] | subprocess.Popen[str]:
        if not isinstance(what, str):
            node = NodeProcess("controller", what, log=self._log, domain=domain)
            return node.process
        with self._log.open("wb") as output:
            return subprocess.Popen(  # noqa: S603  # our own script
                [sys.executable, str(FilePath(__file__).with_name(what))],
                env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
                stdout=output,
                stderr=subprocess.STDOUT,
                process_group=0,
            )

    def _receive(self, command: TwistStamped) -> None:
        arrived = time.perf_counter()
        sent = self._sent.pop(stamp_nanoseconds(command.header), None)
        if sent is None:  # a stop, which no odometry asked for
            return
        self.latency.append(arrived - sent)
        self._twist = (command.twist.linear.x, command.twist.angular.z)
        self.moved = True

    def feed(self, rate: float, enough: Callable[[int], bool]) -> None:
        """Send odometry at a rate [Hz] until so many messages are enough."""
        self._sent.clear()
        count, due = 0, time.perf_counter()
        while not enough(count):
            stamp = int(self._node.get_clock().now().nanoseconds)
            self._pose = advance_pose(self._pose, *self._twist, 1.0 / rate)
            message = odometry_message(stamp, self._pose, np.array(self._twist), ("odom", "base"))
            self._sent[stamp] = time.perf_counter()
            self._odometry.publish(message)
            count, due = count + 1, due + 1.0 / rate
            while (left := due - time.perf_counter()) > 0.0:
                self._executor.spin_once(timeout_sec=left)

    def started(self) -> float:
        """Return how long it took from the start to the first command [s].

        The path is published five times a second, as planners do.

        Raises:
            SystemExit: There was none.

        """
        end = time.perf_counter() + _PATIENCE

        def enough(count: int) -> bool:
            if count % 20 == 0:
                self._path.publish(self._route)
            return self.moved or time.perf_counter() > end

        self.feed(100.0, enough)
        if not self.moved:
            sys.exit(f"{self.name} sent no command within {_PATIENCE:g} s: {self._log}")
        return time.perf_counter() - self._begun

    def processor_time(self) -> float:
        """Return the processor time that the process has used [s]."""
        stat = FilePath(f"/proc/{self.process.pid}/stat").read_text(encoding="utf-8")
        user, system = stat.rpartition(")")[2].split()[11:13]
        return (int(user) + int(system)) / _TICKS

    def memory(self) -> float:
        """Return the resident memory [MB]."""
        pages = FilePath(f"/proc/{self.process.pid}/statm").read_text(encoding="utf-8").split()[1]
        return int(pages) * _PAGE / 1e6

    def close(self) -> None:
        """End the process, and leave the domain."""
        os.killpg(self.process.pid, signal.SIGINT)
        try:
            self.process.wait(10.0)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()


# Name -> a script, or the controller with parameters.
CONTENDERS: dict[str, dict[str, Any] | str] = {
    "relay": "relay.py",
    "loaded relay": "loaded_relay.py",
    "controller": _CONTROLLER,
    "controller, not learning": {**_CONTROLLER, "learning": False},
}
# Compared pairs, and whether there is a target for them.
_COMPARED = (
    ("relay", "relay", False),
    ("loaded relay", "relay", False),
    ("controller", "relay", True),
    ("controller", "loaded relay", False),
    ("controller, not learning", "relay", True),
)


def turns(folder: FilePath, rounds: int, seconds: float) -> list[Row]:
    """Return processor time and latency at every rate."""
    rows = []
    with ExitStack() as stack:
        contenders = []
        for name in CONTENDERS:
            contender = Contender(name, stack.enter_context(own_domain()), folder)
            stack.callback(contender.close)
            contenders.append(contender)
        for contender in contenders:
            contender.started()
            contender.feed(200.0, lambda count: count >= _WARM_UP)
        for rate in _RATES:
            used = {contender.name: 0.0 for contender in contenders}
            latency: dict[str, list[float]] = {contender.name: [] for contender in contenders}
            for _ in range(rounds):
                for contender in contenders:
                    contender.latency.clear()
                    before, wanted = contender.processor_time(), round(seconds * rate)
                    contender.feed(rate, lambda count, wanted=wanted: count >= wanted)
                    used[contender.name] += contender.processor_time() - before
                    if not contender.latency:
                        sys.exit(f"{contender.name} answered nothing at {rate:g} Hz")
                    latency[contender.name] += contender.latency
            print(f"{rate:g} Hz done", file=sys.stderr)
            rows += _rows(rate, used, latency, rounds * seconds)
    return rows


def _rows(
    rate: float, used: dict[str, float], latency: dict[str, list[float]], duration: float
) -> list[Row]:
    found = {
        name: (
            ("processor", 100.0 * used[name] / duration, "% of a core", 1.5),
            ("latency, median", 1e3 * float(np.median(latency[name])), "ms", 1.5),
            ("latency, 99 %", 1e3 * float(np.quantile(latency[name], 0.99)), "ms", None),
        )
        for name in used
    }
    rows = []
    for name, against, has_target in _COMPARED:
        for mine, other in zip(found[name], found[against], strict=True):
            what, value, unit, target = mine
            ratio = value / max(other[1], 1e-9)
            heading = f"{rate:g} Hz, {name}: {what}"
            rows.append(Row(heading, value, unit, ratio, against, target if has_target else None))
    return rows


def starts(folder: FilePath, rounds: int) -> list[Row]:
    """Return how long it takes from the start of the process to the first command."""
    times: dict[str, list[float]] = {name: [] for name in ("relay", "loaded relay", "controller")}
    for _ in range(rounds):
        for name, found in times.items():
            with own_domain() as domain:
                contender = Contender(name, domain, folder)
                try:
                    found.append(contender.started())
                finally:
                    contender.close()
    relay = float(np.median(times["relay"]))
    return [
        Row(
            f"start to first command, {name}",
            float(np.median(found)),
            "s",
            float(np.median(found)) / relay,
            "relay",
            1.5 if name == "controller" else None,
        )
        for name, found in times.items()
    ]


def memory(folder: FilePath, seconds: float) -> list[Row]:
    """Return the memory of a controller after some time at 100 Hz, and how fast it grows then."""
    with own_domain() as domain:
        contender = Contender("controller", domain, folder)
        try:
            contender.started()
            contender.feed(200.0, lambda count: count >= _WARM_UP)
            found = []
            step = seconds / 60.0
            for _ in range(60):
                contender.feed(100.0, lambda count: count >= math.ceil(100.0 * step))
                found.append(contender.memory())
        finally:
            contender.close()
    late = np.array(found[20:])
    slope = np.polyfit(step * np.arange(len(late)) / 60.0, late, 1)[0]
    return [
        Row(f"memory of the controller after {seconds:g} s", found[-1], "MB"),
        Row(f"its growth in the last two thirds of {seconds:g} s", 1e3 * float(slope), "kB/min"),
    ]


def main() -> None:
    """Print the table, and write the results if asked."""
    parser = arguments(__doc__)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each turn")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each node at each rate")
    parser.add_argument("--memory", type=float, default=600.0, help="seconds of driving; 0 skips")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = FilePath(name)
        rows = [*turns(folder, given.rounds, given.seconds), *starts(folder, 3 * given.rounds)]
        if given.memory > 0.0:
            rows += memory(folder, given.memory)
    report(rows, given.json)


if __name__ == "__main__":
    main()
