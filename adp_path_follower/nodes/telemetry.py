"""The controller's debug topics and diagnostics: published only while somebody listens."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseStamped, Vector3Stamped
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import ColorRGBA, Float64, Float64MultiArray, String
from visualization_msgs.msg import Marker, MarkerArray

from adp_path_follower.core.follower import FollowerOutput
from adp_path_follower.core.path import Path
from adp_path_follower.core.supervisor import State, Status
from adp_path_follower.nodes.conversions import (
    array_message,
    error_message,
    make_header,
    pose_message,
    pose_stamped,
)

EVERY_STEP = QoSProfile(depth=10)
# For steps that follow odometry, perhaps in lock-step at the machine's pace: a recorder that joins
# a second late, or is kept waiting that long, still gets all.
LOSSLESS = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)

_LEVELS = {
    State.INACTIVE: DiagnosticStatus.WARN,
    State.WAITING: DiagnosticStatus.WARN,
    State.FOLLOWING: DiagnosticStatus.OK,
    State.GOAL_REACHED: DiagnosticStatus.OK,
    State.FAULT: DiagnosticStatus.ERROR,
}


class Telemetry:
    """Publishers of everything but the command."""

    def __init__(self, node: Node, labels: tuple[str, ...], lossless: bool) -> None:
        """Create the publishers.

        Args:
            node: The controller.
            labels: Names of the terms of the basis.
            lossless: Publish every step whether or not somebody listens, for those who join late.

        """
        self._lossless = lossless
        self._name = node.get_fully_qualified_name()  # two robots share /diagnostics
        self._markers = node.create_publisher(MarkerArray, "~/markers", LATCHED)
        self._configuration = node.create_publisher(String, "~/configuration", LATCHED)
        self._diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

        def scalar(value: Any) -> Float64:
            return Float64(data=float(value))

        # Topic name -> how to make its message of a step's time [ns], frame, output and cost.
        makers: dict[str, tuple[type, Callable[[int, str, FollowerOutput, float], Any]]] = {
            "~/target": (
                PoseStamped,
                lambda t, frame, out, _: pose_stamped(t, frame, out.target_pose),
            ),
            "~/tracking_error": (
                Vector3Stamped,
                lambda t, frame, out, _: error_message(t, frame, out.error),
            ),
            "~/critic_weights": (
                Float64MultiArray,
                lambda t, frame, out, _: array_message(labels, out.weights.critic),
            ),
            "~/actor_weights": (
                Float64MultiArray,
                lambda t, frame, out, _: array_message(labels, out.weights.actor),
            ),
            "~/bellman_error": (Float64, lambda t, frame, out, _: scalar(out.bellman_error)),
            "~/excitation": (Float64, lambda t, frame, out, _: scalar(out.excitation)),
            "~/cost": (Float64, lambda t, frame, out, cost: scalar(cost)),
        }
        self._steps: list[tuple[Publisher, Callable[..., Any]]] = [
            (node.create_publisher(kind, topic, LOSSLESS if lossless else EVERY_STEP), make)
            for topic, (kind, make) in makers.items()
        ]

    def destroy(self, node: Node) -> None:
        """Destroy the publishers."""
        publishers = [publisher for publisher, _ in self._steps]
        for publisher in (self._markers, self._configuration, self._diagnostics, *publishers):
            node.destroy_publisher(publisher)

    def step(self, time: int, frame: str, output: FollowerOutput, cost: float) -> None:
        """Publish what one control step at a time [ns] found; cost is J so far."""
        for publisher, make in self._steps:
            if self._lossless or publisher.get_subscription_count():
                publisher.publish(make(time, frame, output, cost))

    def markers(self, time: int, frame: str, path: Path, output: FollowerOutput | None) -> None:
        """Publish the path and the virtual target for RViz and Foxglove."""
        if not self._markers.get_subscription_count() and output is not None:
            return
        line = Marker(header=make_header(time, frame), ns="path", type=Marker.LINE_STRIP)
        line.scale.x = 0.03
        line.color = ColorRGBA(r=0.2, g=0.5, b=1.0, a=0.8)
        line.points = [Point(x=x, y=y) for x, y, _ in path.points(0.1).tolist()]
        markers = [line]
        if output is not None:
            target = Marker(header=make_header(time, frame), ns="target", type=Marker.ARROW)
            target.pose = pose_message(output.target_pose)
            target.scale.x, target.scale.y, target.scale.z = 0.5, 0.08, 0.08
            target.color = ColorRGBA(r=1.0, g=0.5, b=0.0, a=1.0)
            markers = [target]
        self._markers.publish(MarkerArray(markers=markers))

    def configuration(self, text: str) -> None:
        """Publish what this run is: settings, version and path, as YAML."""
        self._configuration.publish(String(data=text))

    def diagnostics(
        self,
        time: int,
        status: Status,
        path_problem: str,
        learning_problem: str,
        values: dict[str, str],
    ) -> None:
        """Publish state and cause, whether the last path was refused, and how learning goes."""
        level = max(
            _LEVELS[status.state],
            DiagnosticStatus.ERROR if path_problem else DiagnosticStatus.OK,
            DiagnosticStatus.WARN if learning_problem else DiagnosticStatus.OK,
        )
        message = status.state.value + (f": {status.cause}" if status.cause else "")
        if path_problem:
            message += f"; path refused: {path_problem}"
        if learning_problem:
            message += f"; Riccati policy instead of the learned one: {learning_problem}"
        details = {"state": status.state.value, "cause": status.cause, "remedy": status.remedy}
        entry = DiagnosticStatus(
            level=level,
            name=self._name,
            message=message,
            hardware_id="",
            values=[KeyValue(key=key, value=value) for key, value in {**details, **values}.items()],
        )
        self._diagnostics.publish(DiagnosticArray(header=make_header(time, ""), status=[entry]))
