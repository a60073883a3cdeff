"""The controller's debug topics and diagnostics: published only while somebody listens."""

import math
import time as steady
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseStamped, Vector3Stamped
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from std_msgs.msg import ColorRGBA, Float64, Float64MultiArray, String
from visualization_msgs.msg import Marker, MarkerArray

from adp_path_follower import __version__
from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.driving.output import FollowerOutput
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.route import Route
from adp_path_follower.core.safety.supervisor import State, Status
from adp_path_follower.core.settings.groups import ControllerSettings
from adp_path_follower.messages.raw import (
    array_message,
    stamped_numbers,
    step_message,
)
from adp_path_follower.messages.topics import STEP_TOPICS
from adp_path_follower.ros.runtime.conversions import make_header, pose_message
from adp_path_follower.ros.runtime.qos import (
    ALL_CHANGES,
    EVERY_STEP,
    LATCHED,
    LOSSLESS,
    repeat_until_delivered,
)

_LISTENERS_PERIOD = 0.1  # [s], steady: how often it is asked who listens
_MARKER_PERIOD = 0.1  # [s], steady: of the virtual target
_MARKER_POINTS = 2000  # of a long path: each takes a microsecond or two of the control thread

# Types of the debug topics that tell no single number.
_STEP_TYPES = {"target": PoseStamped, "tracking_error": Vector3Stamped}
_STEP_TYPES |= {"critic_weights": Float64MultiArray, "actor_weights": Float64MultiArray}

_LEVELS = {
    State.INACTIVE: DiagnosticStatus.WARN,
    State.WAITING: DiagnosticStatus.WARN,
    State.FOLLOWING: DiagnosticStatus.OK,
    State.GOAL_REACHED: DiagnosticStatus.OK,
    State.STOPPED: DiagnosticStatus.WARN,
    State.FAULT: DiagnosticStatus.ERROR,
}
_RICCATI = "Riccati policy instead of the learned one: "
_IDEAL = "the ideal robot's model instead of the learned one: "


class StatusLog:
    """Tells the log a status when it changes; where only its cause does, once a second."""

    def __init__(self, log: RcutilsLogger) -> None:
        self._log, self._told, self._until = log, Status(State.INACTIVE), 0.0

    def tell(self, status: Status, now: float) -> bool:
        """Tell a status at a steady time [s], if it is time; return whether it was."""
        same_state = status.state is self._told.state
        if status == self._told or (same_state and now < self._until):
            return False
        self._told, self._until = status, now + 1.0
        text = ": ".join(filter(None, [status.state.value, status.cause]))
        if status.state is State.FAULT:
            self._log.error(f"{text}; {status.remedy}")
        else:
            self._log.info(text)
        return True


def _quiet_publisher(node: Node, kind: type, topic: str, qos: QoSProfile | int) -> Publisher:
    """Return a publisher that does not warn of subscribers with an incompatible quality of service.

    rclpy would look for such events before each message that the node takes, at great cost.
    """
    silent = PublisherEventCallbacks(use_default_callbacks=False)
    return node.create_publisher(kind, topic, qos, event_callbacks=silent)


class Telemetry:
    """Publishers of everything but the command."""

    def __init__(
        self,
        node: Node,
        labels: tuple[str, ...],
        lossless: bool,
        controller: Callable[[], ControllerSettings],
    ) -> None:
        """Create the publishers; `lossless` keeps first steps for late subscribers."""
        self._node, self._controller, self._period_told = node, controller, 0
        self._kept = 0  # steps that were published for those who join late
        self._listeners_known_until = self._next_marker = 0.0
        self._lossless = lossless
        self._logger = node.get_logger()
        self._learning_problem = ""
        self._status = _quiet_publisher(node, DiagnosticStatus, "~/status", LATCHED)
        self._last_status: DiagnosticStatus | None = None
        self._name = node.get_fully_qualified_name()  # two robots share /diagnostics
        self._markers = _quiet_publisher(node, MarkerArray, "~/markers", LATCHED)
        self._configuration = _quiet_publisher(node, String, "~/configuration", ALL_CHANGES)
        self._robot = _quiet_publisher(node, Float64MultiArray, "~/robot_model", LATCHED)
        self._diagnostics = _quiet_publisher(node, DiagnosticArray, "/diagnostics", 10)
        # Whether or not somebody listens: without it a run cannot be replayed.
        self._measured = [
            _quiet_publisher(node, Vector3Stamped, topic, LOSSLESS)
            for topic in ("~/measured_pose", "~/measured_motion")
        ]
        self._labels = labels
        qos = LOSSLESS if lossless else EVERY_STEP
        self._steps: list[tuple[Publisher, str]] = [
            (_quiet_publisher(node, _STEP_TYPES.get(topic, Float64), f"~/{topic}", qos), topic)
            for topic in STEP_TOPICS
        ]
        self._heard = self._steps  # those of them that somebody listens to

    def destroy(self) -> None:
        """Destroy the publishers."""
        others = (self._robot, self._markers, self._configuration, self._diagnostics, self._status)
        for publisher in (*others, *self._measured, *(publisher for publisher, *_ in self._steps)):
            self._node.destroy_publisher(publisher)

    def step(
        self,
        time: int,
        frame: str,
        measured: tuple[FloatArray, FloatArray],
        output: FollowerOutput,
        cost: float,
    ) -> None:
        """Publish a control step at a time [ns], with what it measured; cost is J so far."""
        self.measured(time, frame, measured)
        for publisher, topic in self._steps_to_tell(time):
            publisher.publish(step_message(topic, time, frame, output, cost, self._labels))

    def measured(self, time: int, frame: str, values: tuple[FloatArray, FloatArray]) -> None:
        """Publish what a step at a time [ns] went by.

        Values are x, y, theta, shape (3,), and v, w and the age of the odometry [s], shape (3,).
        """
        for publisher, numbers in zip(self._measured, values, strict=True):
            publisher.publish(stamped_numbers(time, frame, numbers.tolist()))

    def _steps_to_tell(self, time: int) -> list[tuple[Publisher, str]]:
        """Return what to publish of a step at a time [ns]; to count subscribers is expensive."""
        if self._lossless and self._kept < LOSSLESS.depth:
            self._kept += 1
            wanted = self._steps
        else:
            now = steady.monotonic()
            if now >= self._listeners_known_until:
                self._listeners_known_until = now + _LISTENERS_PERIOD
                self._heard = [step for step in self._steps if step[0].get_subscription_count()]
            wanted = self._heard
        rate = self._controller().debug_rate
        if not wanted or math.isinf(rate):
            return wanted
        period = math.floor(time * 1e-9 * rate)  # each is told of once, by its first step
        if period == self._period_told:
            return []
        self._period_told = period
        return wanted

    def markers(self, time: int, frame: str, path: Route, output: FollowerOutput | None) -> None:
        """Publish the path, or on it, not too often, the virtual target, for RViz and Foxglove."""
        now = steady.monotonic()
        if output is None:
            marker = Marker(header=make_header(time, frame), ns="path", type=Marker.LINE_STRIP)
            marker.scale.x = 0.03
            marker.color = ColorRGBA(r=0.2, g=0.5, b=1.0, a=0.8)
            spacing = max(0.1, path.length / _MARKER_POINTS)
            marker.points = [Point(x=x, y=y) for x, y, _ in path.points(spacing).tolist()]
        elif now >= self._next_marker and self._markers.get_subscription_count():
            self._next_marker = now + _MARKER_PERIOD
            marker = Marker(header=make_header(time, frame), ns="target", type=Marker.ARROW)
            marker.pose = pose_message(output.target_pose)
            marker.scale.x, marker.scale.y, marker.scale.z = 0.5, 0.08, 0.08
            marker.color = ColorRGBA(r=1.0, g=0.5, b=0.0, a=1.0)
        else:
            return
        self._markers.publish(MarkerArray(markers=[marker]))

    def configuration(self, text: str) -> None:
        """Publish what this run is: settings, version and path, as YAML."""
        self._configuration.publish(String(data=text))

    def learning(self, problem: str) -> bool:
        """Say when the Riccati policy takes over, for a problem, and back; return if it did."""
        if problem == self._learning_problem:
            return False
        self._learning_problem = problem
        if problem:
            self._logger.warning(
                f"learning has gone wrong: {problem}; the Riccati policy has taken over where it "
                "did, until learning succeeds"
            )
        else:
            self._logger.info("learning succeeds again: the learned policy is back")
        return True

    def diagnostics(
        self,
        time: int,
        status: Status,
        since: int,
        path_problem: str,
        driver: Driver,
        topic_problem: str = "",
    ) -> None:
        """Publish the state (which began at `since` [ns]), problems, and what was learned.

        On /diagnostics always, with all values; on ~/status, which is latched, when it changes.
        """
        values = {"version": __version__}
        if driver.follower is not None:
            values["arc_length [m]"] = f"{float(driver.follower.arc_length):.3f}"
            values["cost"] = f"{float(driver.follower.cost):.6g}"
        report = driver.robot.report  # empty of a robot that is taken for ideal
        if report:
            self._robot.publish(array_message(report, [*report.values()]))
        values.update({name: f"{value:.4g}" for name, value in report.items()})
        level = _LEVELS[status.state]
        message = status.state.value + (f": {status.cause}" if status.cause else "")
        for head, problem, severity in (
            ("path rejected: ", path_problem, DiagnosticStatus.ERROR),
            ("", topic_problem, DiagnosticStatus.WARN),
            (_RICCATI, self._learning_problem, DiagnosticStatus.WARN),
            (_IDEAL, driver.robot.problem, DiagnosticStatus.WARN),
        ):
            if problem:
                level = max(level, severity)
                message += f"; {head}{problem}"
        details = {
            "state": status.state.value,
            "cause": status.cause,
            "remedy": status.remedy,
            "since [s]": f"{since * 1e-9:.3f}",
        }

        def entry(shown: dict[str, str]) -> DiagnosticStatus:
            pairs = [KeyValue(key=key, value=value) for key, value in shown.items()]
            return DiagnosticStatus(level=level, name=self._name, message=message, values=pairs)

        everything = entry({**details, **values})
        self._diagnostics.publish(
            DiagnosticArray(header=make_header(time, ""), status=[everything])
        )
        own = entry(details)
        if own != self._last_status:
            self._last_status = own
            self._status.publish(own)

    def deliver_status(self) -> None:
        """Wait, not for long, until whoever listens to ~/status has got the last."""
        last = self._last_status
        if last is not None:
            repeat_until_delivered(self._status, lambda: self._status.publish(last))
