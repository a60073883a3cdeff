"""Drive for an hour of simulated time with random faults, changes of parameters and of paths.

    python bench/endurance/hour.py [--minutes 60] [--factor 3] [--seed 0] [--out DIR]

Controller and simulator run as processes, in simulated time that runs faster than the clock on the
wall. Every few simulated seconds an event happens through topics and services, chosen by a seed:
a fault of the robot or of its messages, new parameters (some of them rejected), another path, an
empty one, a stop, a reset of the learning, a listener that comes and goes. It fails if the
controller ends, prints a traceback or an unexpected error, sends a command that is not finite or
beyond the limits, or does not follow any more at the end; it reports how its memory grows after the
first five minutes. DIR gets hour.json and hour.png.
"""

from __future__ import annotations

import argparse
import collections
import json
import math
import os
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path as FilePath
from typing import Any

import matplotlib as mpl
import numpy as np

sys.path.insert(0, str(FilePath(__file__).resolve().parents[2] / "test" / "support"))

# The tests' nodes and a peer on their domain.
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
from matplotlib.figure import Figure
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Float64MultiArray, Header
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import named_path
from adp_path_follower.drawing.figure_style import COLORS, STYLE
from adp_path_follower.ros.runtime.conversions import poses_message
from adp_path_follower.study.demo import NodeProcess, own_domain
from live_nodes import Peer, is_zero  # after the path

WARM_UP = 5.0  # [min] after which memory must not grow any more
_WINDOW = 60.0  # [s] of simulated time over which memory is averaged at either end
_FASTEST, _SHARPEST = 1.0, 1.5  # the largest limits that are ever set
_ROBOT = {
    "position_noise": 0.005,
    "heading_noise": 0.005,
    "velocity_lag": 0.05,
    "linear_slip": 0.02,
}
_FAULTS: tuple[dict[str, Any], ...] = (
    {"odometry_corruption": "nan"},
    {"odometry_corruption": "infinite"},
    {"odometry_corruption": "zero_quaternion"},
    {"odometry_offset": [2.0, -1.0, 0.5]},
    {"odometry_stamp_offset": -1.0},
    {"odometry_stamp_offset": 0.3},
    {"reported_base_frame": "other"},
    {"reported_odom_frame": "map"},
    {"clock_stops": True},
    {"clock_offset": -2.0},
    {"odometry_drop": 1.0},
    {"odometry_drop": 0.6, "odometry_duplicate": 0.3},
    {"push": [0.0, 2.0, 0.0]},
    {"push": [0.0, 0.0, 3.0]},
    {"friction": 0.02},
    {"position_noise": 0.1, "heading_noise": 0.1},
    {"command_delay": 0.1, "odometry_delay": 0.1},
    {"max_linear_vel": 0.1},
)
_CHANGES: tuple[dict[str, Any], ...] = (
    {"desired_speed": 0.3},
    {"desired_speed": 0.5},
    {"max_linear_vel": 0.6, "max_angular_vel": 1.0},
    {"max_linear_vel": _FASTEST, "max_angular_vel": _SHARPEST},
    {"state_cost": [2.0, 3.0, 1.0]},
    {"state_cost": [1.0, 1.0, 1.0]},
    {"target_gain": 0.5},
    {"target_gain": 0.1},
    {"learning": False},
    {"learning": True},
    {"max_cross_track_error": 0.5},
    {"desired_speed": -7.0},  # refused
    {"input_cost": [1.0, -1.0]},  # refused
    {"no_such_parameter": 1.0},  # refused
)


def resident_memory(pid: int) -> float:
    """Return the resident memory of a process [MB]."""
    pages = int(FilePath(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class Hour:
    """One long drive."""

    def __init__(self, peer: Peer, start: Callable[..., NodeProcess], factor: float, seed: int):
        """Start controller and simulator."""
        self.peer, self.chance = peer, random.Random(seed)  # noqa: S311  # no secrets
        self.counts: collections.Counter[str] = collections.Counter()
        self.states: collections.Counter[str] = collections.Counter()
        self.refused = self.commands = self.motions = 0
        self.problems: list[str] = []
        self.memory: list[tuple[float, float]] = []
        self.time = self._first_time = 0.0
        self._factor = factor
        latched = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        peer.node.create_subscription(TwistStamped, "cmd_vel", self._take_command, 100)
        peer.node.create_subscription(Odometry, "ground_truth", self._take_truth, 10)
        peer.node.create_subscription(
            DiagnosticStatus, "path_follower/status", self._take_status, latched
        )
        self.controller = start("controller", use_sim_time=True, controller_frequency=50.0)
        self.simulator = start(
            "sim_unicycle",
            publish_clock=True,
            real_time_factor=factor,
            rate=50.0,
            seed=seed,
            **_ROBOT,
        )
        peer.until_matched(peer.path)
        self.new_path()
        peer.until(lambda: self.states["following"], "the first drive")
        self._first_time = self.time

    @property
    def elapsed(self) -> float:
        """Return the simulated time since the drive began [s]."""
        return self.time - self._first_time

    def _take_command(self, command: TwistStamped) -> None:
        self.commands += 1
        self.motions += not is_zero(command)
        v, w = command.twist.linear.x, command.twist.angular.z
        sound = 0.0 <= v <= _FASTEST + 1e-9 and abs(w) <= _SHARPEST + 1e-9  # false for NaN, too
        if not sound and len(self.problems) < 10:
            self.problems.append(f"at {self.elapsed:.1f} s the command was {v}, {w}")

    def _take_truth(self, message: Odometry) -> None:
        self.time = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec

    def _take_status(self, status: DiagnosticStatus) -> None:
        self.states[next(item.value for item in status.values if item.key == "state")] += 1

    def run(self, minutes: float, report: Callable[[], None]) -> None:
        """Drive for simulated minutes."""
        happenings = (
            (self.fault, 5),
            (self.change_parameters, 4),
            (self.new_path, 2),
            (self.empty_path, 1),
            (self.stop_and_resume, 1),
            (self.reset_learning, 1),
            (self.listen_for_a_while, 1),
        )
        happen, weights = zip(*happenings, strict=True)
        next_report = 0.0
        while self.elapsed < 60.0 * minutes and self.alive():
            self.spin(self.chance.uniform(1.0, 4.0))
            action = self.chance.choices(happen, weights)[0]
            self.counts[action.__name__] += 1
            action()
            self.memory.append((self.elapsed, resident_memory(self.controller.process.pid)))
            if self.elapsed >= next_report:
                report()
                next_report = self.elapsed + 60.0
        if self.alive():
            self.settle()

    def alive(self) -> bool:
        """Return whether both nodes run."""
        return all(node.process.poll() is None for node in (self.controller, self.simulator))

    def settle(self) -> None:
        """Check that the robot drives on after all faults."""
        self.set("path_follower", {"learning": True, "max_cross_track_error": math.inf})
        self.new_path()
        self.peer.call(Trigger, "path_follower/resume")
        seen = self.motions
        try:
            self.peer.until(lambda: self.motions > seen + 100, "commands to move at the end")
        except AssertionError as error:
            self.problems.append(str(error))

    def spin(self, seconds: float) -> None:
        """Take messages for a simulated time; it goes on while the simulator's clock is faulty."""
        self.peer.pause(seconds / self._factor)

    def set(self, node: str, values: dict[str, Any]) -> None:
        """Set parameters of a node as a set; count it if they are rejected."""
        request = SetParametersAtomically.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg() for name, value in
                        values.items()]
        )  # fmt: skip
        answer = self.peer.call(
            SetParametersAtomically, f"{node}/set_parameters_atomically", request
        )
        self.refused += not answer.result.successful

    # Events

    def fault(self) -> None:
        """Let the robot or its messages be faulty for a while."""
        values = self.chance.choice(_FAULTS)
        sound = {
            "odometry_corruption": "none",
            "odometry_offset": [0.0, 0.0, 0.0],
            "odometry_stamp_offset": 0.0,
            "reported_base_frame": "",
            "reported_odom_frame": "",
            "clock_stops": False,
            "clock_offset": 0.0,
            "odometry_drop": 0.0,
            "odometry_duplicate": 0.0,
            "push": [0.0, 0.0, 0.0],
            "friction": math.inf,
            "heading_noise": _ROBOT["heading_noise"],
            "position_noise": _ROBOT["position_noise"],
            "command_delay": 0.0,
            "odometry_delay": 0.0,
            "max_linear_vel": math.inf,
        }
        self.set("unicycle_sim", values)
        self.spin(self.chance.uniform(0.1, 2.0) * (0.2 if "push" in values else 1.0))
        self.set("unicycle_sim", {name: sound[name] for name in values})
        self.peer.call(Trigger, "path_follower/resume")  # from too large an error

    def change_parameters(self) -> None:
        """Set parameters of the controller, good or bad ones."""
        values = self.chance.choice(_CHANGES)
        self.set("path_follower", values)
        if "max_cross_track_error" in values:  # else the robot would not move for long
            self.spin(1.0)
            self.set("path_follower", {"max_cross_track_error": math.inf})
            self.peer.call(Trigger, "path_follower/resume")

    def new_path(self) -> None:
        """Publish another path."""
        kind = self.chance.choice(("lissajous", "circle:0.5", "circle:-1.0", "random"))
        if kind == "random":
            x = np.linspace(0.0, 20.0, 400)
            a, b, c = (self.chance.uniform(0.2, 1.0) for _ in range(3))
            path = Path.from_points(np.column_stack([x, a * np.sin(b * x + c)]))
        else:
            path = named_path(kind)
        self.peer.path.publish(poses_message(path.points(0.1), "odom", 0))

    def empty_path(self) -> None:
        """Publish an empty path, and another one after it."""
        self.peer.path.publish(PathMessage(header=Header(frame_id="odom")))
        self.spin(0.5)
        self.new_path()

    def stop_and_resume(self) -> None:
        """Stop the robot for a while."""
        self.peer.call(Trigger, "path_follower/stop")
        self.spin(0.5)
        self.peer.call(Trigger, "path_follower/resume")

    def reset_learning(self) -> None:
        """Reset learning."""
        self.peer.call(Trigger, "path_follower/reset_learning")

    def listen_for_a_while(self) -> None:
        """Let a listener to the debug topics come and go."""
        node = self.peer.node
        listeners = [
            node.create_subscription(kind, f"path_follower/{topic}", lambda message: None, 10)
            for kind, topic in (
                (Float64MultiArray, "critic_weights"),
                (MarkerArray, "markers"),
            )
        ]
        self.spin(2.0)
        for listener in listeners:
            node.destroy_subscription(listener)

    def growth(self) -> float:
        """Return the share by which memory has grown since the warm-up; NaN for a short drive."""
        times, memory = np.array(self.memory).T
        start, end = 60.0 * WARM_UP, times[-1]
        if end < start + 2.0 * _WINDOW:
            return math.nan
        first = np.median(memory[(times >= start) & (times < start + _WINDOW)])
        last = np.median(memory[times > end - _WINDOW])
        return float(last / first - 1.0)


def draw(hour: Hour, file: FilePath) -> None:
    """Draw memory over time."""
    times, memory = np.array(hour.memory).T
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(5.0, 3.0), layout="constrained")
        axes = figure.subplots()
        axes.plot(times / 60.0, memory, lw=1.0, color=COLORS[0])
        axes.axvline(WARM_UP, color="0.6", lw=0.8)
        axes.set(
            xlabel="simulated time [min]",
            ylabel="memory of the controller [MB]",
            ylim=(0, 1.1 * memory.max()),
        )
        figure.savefig(file)


def summary(hour: Hour, minutes: float, wall: float) -> dict[str, Any]:
    """Return the results; problems include errors that the controller printed."""
    problems = list(hour.problems)
    code = hour.controller.process.poll()
    if code is not None:
        problems.append(f"the controller ended with {code}: {hour.controller.last_line()}")
    problems += [
        line
        for node in (hour.controller, hour.simulator)
        for line in node.output().splitlines()
        if "Traceback" in line or "unexpected error" in line
    ]
    growth = hour.growth()
    if growth > 0.01:
        problems.append(f"memory grew by {100.0 * growth:.2f} %, which is more than 1 %")
    return {
        "simulated_minutes": hour.elapsed / 60.0,
        "asked_minutes": minutes,
        "wall_minutes": wall / 60.0,
        "load": os.getloadavg(),
        "happened": dict(hour.counts),
        "refused_changes": hour.refused,
        "states": dict(hour.states),
        "commands": hour.commands,
        "commands_to_move": hour.motions,
        "memory_growth": growth,
        "memory": hour.memory,
        "problems": problems,
    }


def main() -> int:
    """Drive, print the results, and return 1 if there was a problem."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="simulated (default: 60)")
    parser.add_argument("--factor", type=float, default=3.0, help="simulated s per s (default: 3)")
    parser.add_argument("--seed", type=int, default=0, help="of all that happens (default: 0)")
    parser.add_argument("--out", type=FilePath, help="directory for hour.json and hour.png")
    arguments = parser.parse_args()
    begun = time.monotonic()
    nodes: list[NodeProcess] = []
    with own_domain() as domain, tempfile.TemporaryDirectory() as logs:
        peer = Peer(domain)

        def start(executable: str, **values: Any) -> NodeProcess:
            log = FilePath(arguments.out or logs) / f"{executable}.log"
            log.parent.mkdir(parents=True, exist_ok=True)
            nodes.append(NodeProcess(executable, values, log=log, domain=domain))
            return nodes[-1]

        try:
            hour = Hour(peer, start, arguments.factor, arguments.seed)

            def report() -> None:
                time, memory = hour.memory[-1]
                print(f"{time / 60.0:6.1f} min{memory:9.2f} MB", flush=True)

            hour.run(arguments.minutes, report)
            found = summary(hour, arguments.minutes, time.monotonic() - begun)
        finally:
            peer.close()
            for node in nodes:
                node.stop()
    for name, value in found.items():
        if name not in ("memory", "problems"):
            print(f"{name:20}{value}")
    for problem in found["problems"]:
        print(f"problem: {problem}")
    if arguments.out:
        (arguments.out / "hour.json").write_text(json.dumps(found) + "\n", encoding="utf-8")
        draw(hour, arguments.out / "hour.png")
    return 1 if found["problems"] else 0


if __name__ == "__main__":
    sys.exit(main())
