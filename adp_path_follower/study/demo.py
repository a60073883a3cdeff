"""Controller, simulator, path publisher and recorder as processes, in lock-step."""

import contextlib
import fcntl
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray, pose_in_frame, yaw_of_quaternion
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import Value, flatten, yaml_text
from sim_unicycle.settings import MessageFaultSettings, SimulatorSettings

_READY_TIMEOUT = 60.0  # [s] for a slow machine to import rclpy four times
_STALL_TIMEOUT = 30.0  # [s] without any step
_LEAST_SPACE = 4096  # [bytes] free, without which a node cannot say why it ends
_GOAL_TIMEOUT = 1.0  # [s] without any step after the goal
# Lock-step waits for the machine, so wall time says nothing about the odometry.
_LOCKSTEP = {"control_trigger": "odometry", "path_start": "beginning", "odom_timeout": 30.0}
_SIM_TIME = {"use_sim_time": True}
# Faults are about time, so a robot that has some is driven in real time, as a robot is.
_REAL_TIME = {"path_start": "beginning"}
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
        """Start a node in a ROS domain; `log` gets its output; `arguments` follow parameters."""
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
        full = shutil.disk_usage(self.log.parent).free < _LEAST_SPACE
        why = f"no space left in {self.log.parent} for its log" if full else "nothing in its log"
        return lines[-1] if lines else f"exit code {self.process.poll()}, {why}"

    def stop(self, number: int = signal.SIGINT, timeout: float = 10.0) -> int:
        """Ask the node to end, kill its group if it does not, and return its exit code."""
        if self.process.poll() is None:
            os.killpg(self.process.pid, number)
            try:
                self.process.wait(timeout)
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, signal.SIGKILL)
        return self.process.wait()


@dataclass(frozen=True)
class Progress:
    """Where a run is."""

    time: float  # simulated time since the start [s]
    error: FloatArray  # e = [s, y, theta], shape (3,)
    target_pose: FloatArray  # pose of the virtual target, shape (3,)


def run_closed_loop(
    settings: Settings,
    path: Path,
    path_name: str,
    start: FloatArray,
    duration: float,
    directory: FilePath,
    report: Callable[[Progress | None], None],
    simulator: SimulatorSettings | None = None,
) -> FilePath:
    """Run the four nodes in lock-step, or in real time where there are faults; return the bag.

    The robot, ideal by default, starts with an error [s, y, theta] to the beginning of the path,
    and drives a simulated `duration` [s]; lock-step changes some settings. `path_name` is for the
    publisher; `directory` gets the bag and the nodes' logs. `report` is called while waiting (None)
    and after every step seen. Raises AdpError if a node ends early or the run does not go on.
    """
    logs = directory / "logs"
    logs.mkdir()
    bag = directory / "bag"
    plant, pace = _simulated(simulator or SimulatorSettings(), duration)
    x, y, theta = pose_in_frame(start, path.frame(0.0).pose).tolist()
    with own_domain() as domain:
        nodes: list[NodeProcess] = []

        def launch(executable: str, parameters: dict[str, Any]) -> NodeProcess:
            log = logs / f"{executable}.log"
            nodes.append(NodeProcess(executable, parameters, log=log, domain=domain))
            return nodes[-1]

        try:
            controller = launch("controller", {**flatten(settings), **pace, **_SIM_TIME})
            recorder = launch("recorder", {"output": str(bag), **_SIM_TIME})
            robot = launch("sim_unicycle", {**plant, "x": x, "y": y, "theta": theta})
            # The path starts the run, so it comes when simulator and controller are recorded; the
            # path itself and the configuration after it may be recorded at the very end.
            _wait(nodes, recorder, ("/odom", "/cmd_vel"), lambda: report(None))
            launch("path_publisher", {"path": path_name})
            others = [node for node in nodes if node is not robot]
            _watch(domain, duration, robot, controller, others, report)
            rest = ("/path", "/path_follower/configuration", "/path_follower/tracking_error")
            _wait(others, recorder, rest, lambda: None)
        finally:
            # The recorder last, for it must get the last messages of the others.
            for node in sorted(nodes, key=lambda node: node.name == "recorder"):
                node.stop()
    if recorder.process.returncode != 0:
        raise AdpError(f"the recorder failed: {recorder.last_line()}")
    given_up = re.search(r"recording to .* stopped: .*", recorder.output())
    if given_up is not None:  # a full disk, for example
        raise AdpError(given_up.group())
    return bag


def _simulated(
    settings: SimulatorSettings, duration: float
) -> tuple[dict[str, Value], dict[str, Any]]:
    """Return the simulator's parameters that are not the default, and the controller's for them."""
    plain = flatten(SimulatorSettings())
    values = {name: value for name, value in flatten(settings).items() if value != plain[name]}
    values.pop("robot", None)  # the others are its values already
    faults = settings.simulation.fault_script or settings.message_faults != MessageFaultSettings()
    # In real time the robot waits for its first command, from which the duration counts.
    values["duration"] = duration + _READY_TIMEOUT * bool(faults)
    values["publish_clock" if faults else "lockstep"] = True
    return values, _REAL_TIME if faults else _LOCKSTEP


def _wait(
    nodes: list[NodeProcess],
    recorder: NodeProcess,
    topics: tuple[str, ...],
    idle: Callable[[], None],
) -> None:
    """Wait until the recorder has got something on every topic; AdpError if a node ends before."""
    deadline = time.monotonic() + _READY_TIMEOUT
    while not all(f"recording {topic}\n" in recorder.output() for topic in topics):
        _check_running(nodes)
        if time.monotonic() > deadline:
            raise AdpError(
                f"the nodes did not find each other in {_READY_TIMEOUT:g} s; their logs are in "
                f"{recorder.log.parent}"
            )
        idle()
        time.sleep(0.05)


def _check_running(nodes: list[NodeProcess]) -> None:
    for node in nodes:
        if node.process.poll() is not None:
            raise AdpError(f"{node.name} ended early: {node.last_line()}")


def _watch(
    domain: int,
    duration: float,
    simulator: NodeProcess,
    controller: NodeProcess,
    others: list[NodeProcess],
    report: Callable[[Progress | None], None],
) -> None:
    """Report until the simulator ends, the robot is at the goal, or a time [s] is over.

    Raises AdpError if one of the others ends, or if nothing happens any more.
    """
    seen: Progress | None = None
    seen_at = time.monotonic()
    with _listening(domain) as heard:
        while simulator.process.poll() is None:
            progress = heard()
            if progress is not seen:
                seen, seen_at = progress, time.monotonic()
            report(progress)
            quiet = time.monotonic() - seen_at
            # At the goal, lock-step would wait for commands that never come.
            arrived = quiet > _GOAL_TIMEOUT and "goal reached" in controller.output()
            if arrived or (progress is not None and progress.time > duration):
                simulator.stop()
            _check_running(others)
            if quiet > _STALL_TIMEOUT:
                raise AdpError(
                    f"the run stands still; the nodes' logs are in {simulator.log.parent}"
                )
    if simulator.process.returncode != 0:
        raise AdpError(f"the simulator failed: {simulator.last_line()}")


@contextlib.contextmanager
def _listening(domain: int) -> Iterator[Callable[[], Progress | None]]:
    """Yield what listens for a moment and returns the newest progress of the run, if any."""
    import rclpy  # here, so that `adp` works without ROS
    from geometry_msgs.msg import PoseStamped, Vector3Stamped
    from rclpy.qos import qos_profile_sensor_data as newest
    from rclpy.signals import SignalHandlerOptions

    target = np.zeros(3)
    start: int | None = None
    progress: Progress | None = None

    def take_target(message: Any) -> None:
        nonlocal target
        p, q = message.pose.position, message.pose.orientation
        target = np.array([p.x, p.y, yaw_of_quaternion(q.x, q.y, q.z, q.w)])

    def take_error(message: Any) -> None:
        nonlocal start, progress
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        start = stamp if start is None else start
        error = np.array([message.vector.x, message.vector.y, message.vector.z])
        progress = Progress((stamp - start) * 1e-9, error, target)

    def heard() -> Progress | None:
        rclpy.spin_once(node, timeout_sec=0.05)
        return progress

    # rclpy reads both when it is initialised.
    os.environ |= {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("monitor")
    node.create_subscription(Vector3Stamped, "path_follower/tracking_error", take_error, newest)
    node.create_subscription(PoseStamped, "path_follower/target", take_target, newest)
    try:
        yield heard
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
