"""The controller node: odometry and path in, velocity commands out."""

from __future__ import annotations

import time as steady
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_srvs.srv import Trigger

from adp_path_follower import __version__
from adp_path_follower.core.errors import PathError, SettingsError
from adp_path_follower.core.follower import PathFollower
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path import Path
from adp_path_follower.core.schema import flatten, yaml_text
from adp_path_follower.core.settings import Settings
from adp_path_follower.core.supervisor import State, Status, Supervisor
from adp_path_follower.nodes.conversions import (
    Measurement,
    MessageError,
    measurement_of,
    path_of,
    twist_message,
    twist_stamped,
)
from adp_path_follower.nodes.parameters import changed_settings, declare_settings
from adp_path_follower.nodes.run import Ending, run_node
from adp_path_follower.nodes.telemetry import EVERY_STEP, LOSSLESS, Telemetry

NODE_NAME = "path_follower"

_WATCHDOG_PERIOD = 0.02  # [s], steady
_STOP_DURATION = 0.5  # [s], steady: how long zero velocity is repeated after a stop
_MARKER_PERIOD = 0.1  # [s], steady
_DELIVERY_TIMEOUT = 0.3  # [s]
_LAST_WORDS = 3  # zero velocities before the node goes
_ZERO = np.zeros(2)


class PathFollowerNode(Ending, LifecycleNode):
    """Orchestrate: messages to `PathFollower`, `Supervisor` and back."""

    def __init__(self) -> None:
        """Declare the parameters; the rest waits for the lifecycle."""
        super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True)
        self._settings = declare_settings(self, Settings)
        self.add_on_set_parameters_callback(self._change_parameters)
        self._steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._heard = False  # whether anybody has listened to commands since the activation
        self._command_publisher: Any = None
        self._entities: list[tuple[Any, Any]] = []
        self._forget_run()
        if self._settings.controller.autostart:
            self.trigger_configure()
            self.trigger_activate()

    def _forget_run(self) -> None:
        """Return to the state before any message."""
        self._path: Path | None = None
        self._path_frame = ""
        self._path_problem = ""
        self._learning_problem = ""
        self._follower: PathFollower | None = None
        self._learned: PathFollower | None = None  # the follower of the path before
        self._measurement: Measurement | None = None
        self._step_time: int | None = None
        self._last_command: FloatArray = _ZERO
        self._stop_until = 0.0
        self._shown = Status(State.INACTIVE)
        self._next_diagnostics = 0.0
        self._next_markers = 0.0
        self._supervisor = Supervisor(self._settings.controller.odom_timeout)

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create publishers, subscriptions, services and timers."""
        controller = self._settings.controller
        kind = TwistStamped if controller.enable_stamped_cmd_vel else Twist
        lossless = controller.control_trigger == "odometry"
        self._command_publisher = self.create_publisher(
            kind, "cmd_vel", LOSSLESS if lossless else EVERY_STEP
        )
        labels = self._settings.learning.value_basis.labels
        self._telemetry = Telemetry(self, labels, lossless)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        odom = self.create_subscription(
            Odometry, "odom", self._receive_odometry, qos_profile_sensor_data
        )
        path = self.create_subscription(PathMessage, "path", self._receive_path, latched)
        reset = self.create_service(Trigger, "~/reset_learning", self._reset_learning)
        watchdog = self.create_timer(_WATCHDOG_PERIOD, self._watch, clock=self._steady_clock)
        self._entities = [
            (self.destroy_subscription, odom),
            (self.destroy_subscription, path),
            (self.destroy_service, reset),
            (self.destroy_timer, watchdog),
        ]
        if controller.control_trigger == "timer":
            timer = self.create_timer(1.0 / controller.controller_frequency, self._on_timer)
            self._entities.append((self.destroy_timer, timer))
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Allow commands; zero velocity first."""
        self._supervisor.active = True
        self._heard = False
        self._send(_ZERO, self._now())
        self.get_logger().info("active: following as soon as there are odometry and a path")
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the robot and send no more commands."""
        self.last_words()
        self._supervisor.active = False
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the robot and forget path, odometry and what was learned."""
        self.last_words()
        self._destroy_entities()
        self._forget_run()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the robot and end the node."""
        self.last_words()
        self._supervisor.active = False
        self.finished = True
        return super().on_shutdown(state)

    def last_words(self) -> None:
        """Publish zero velocity three times and wait, not for long, until it was delivered."""
        if self._command_publisher is None:
            return
        for _ in range(_LAST_WORDS):
            self._send(_ZERO, self._now())
            steady.sleep(0.01)
        self._command_publisher.wait_for_all_acked(Duration(seconds=_DELIVERY_TIMEOUT))

    def _destroy_entities(self) -> None:
        for destroy, entity in self._entities:
            destroy(entity)
        self._entities = []
        self._telemetry.destroy(self)
        self.destroy_publisher(self._command_publisher)
        self._command_publisher = None

    # Inputs

    def _receive_odometry(self, message: Odometry) -> None:
        now = steady.monotonic()
        try:
            measurement = measurement_of(message)
        except MessageError as error:
            self._supervisor.odometry_received(now, str(error))
            self._update_status()
            return
        self._supervisor.odometry_received(now)
        self._measurement = measurement
        if self._path is not None and self._path_frame != measurement.frame:
            self._refuse_path(self._wrong_frame(self._path_frame))
            self._path, self._follower = None, None
            self._supervisor.path_removed()
        if self._settings.controller.control_trigger == "odometry":
            self._control(measurement.stamp)

    def _receive_path(self, message: PathMessage) -> None:
        """Take a new path, or refuse it and go on with the present one."""
        frame = message.header.frame_id
        if self._measurement is not None and frame != self._measurement.frame:
            self._refuse_path(self._wrong_frame(frame))
            return
        try:
            path = path_of(message)
        except PathError as error:
            self._refuse_path(str(error))
            return
        self._path_problem = ""
        if self._path is not None and path.digest() == self._path.digest():
            return
        if self._follower is not None:
            self._learned = self._follower
        self._path, self._path_frame, self._follower = path, frame, None
        self._supervisor.path_received()
        kind = "closed" if path.closed else "open"
        self.get_logger().info(f"new path: {kind}, {path.length:.2f} m, in frame '{frame}'")
        self._publish_configuration()
        self._telemetry.markers(self._now(), frame, path, None)

    def _wrong_frame(self, frame: str) -> str:
        odom_frame = self._measurement.frame if self._measurement else ""
        return (
            f"path is in frame '{frame}', but odometry in '{odom_frame}': publish the path in "
            f"'{odom_frame}'"
        )

    def _refuse_path(self, problem: str) -> None:
        self._path_problem = problem
        self.get_logger().error(f"path refused: {problem}")
        self._publish_diagnostics()

    def _change_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Check a change of parameters as a whole; take it over between two steps, or refuse."""
        try:
            settings = changed_settings(self._settings, parameters)
            if settings != self._settings and self._follower is not None:
                self._follower = self._follower.reconfigured(settings)
        except SettingsError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if settings != self._settings:
            self._settings = settings
            self._supervisor.odom_timeout = settings.controller.odom_timeout
            self._publish_configuration()
        return SetParametersResult(successful=True)

    def _reset_learning(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self._learned = None
        if self._follower is not None:
            self._follower.reset_learning()
        response.success, response.message = True, "weights are the initial ones again"
        return response

    # Control

    def _on_timer(self) -> None:
        self._control(self._now())

    def _control(self, time: int) -> None:
        """Compute and publish the command for a time [ns]."""
        if self._update_status().state is not State.FOLLOWING:
            return
        if time == self._step_time:  # the same odometry again: so is the answer
            self._send(self._last_command, time)
            return
        assert self._measurement is not None  # there is no FOLLOWING without odometry
        pose = self._measurement.pose_at(time)
        try:
            follower = self._follower or self._start_following(pose)
        except SettingsError as error:
            self._supervisor.command_refused(str(error))
            self._update_status()
            return
        output = follower.step_at(pose, time)
        if not np.isfinite(output.command).all():
            follower.reset_learning()
            self._supervisor.command_refused("the learner's command is not finite")
            self._update_status()
            return
        self._report_learning(follower.learning_problem)
        self._last_command, self._step_time = output.command, time
        self._send(output.command, time)
        self._telemetry.step(time, self._path_frame, output, float(follower.cost))
        if steady.monotonic() >= self._next_markers:
            self._next_markers = steady.monotonic() + _MARKER_PERIOD
            self._telemetry.markers(time, self._path_frame, follower.path, output)
        if not follower.path.closed and float(follower.arc_length) >= follower.path.length:
            self._supervisor.goal_reached()

    def _start_following(self, pose: FloatArray) -> PathFollower:
        assert self._path is not None  # there is no FOLLOWING without a path
        beginning = self._settings.controller.path_start == "beginning"
        arc_length = 0.0 if beginning else self._path.nearest(pose)
        follower = PathFollower(self._settings, self._path, arc_length)
        if self._learned is not None:
            follower.take_over(self._learned)
        self._follower, self._learned, self._step_time = follower, None, None
        return follower

    def _send(self, command: FloatArray, time: int) -> None:
        if self._settings.controller.enable_stamped_cmd_vel:
            frame = self._measurement.child_frame if self._measurement else "base_link"
            self._command_publisher.publish(twist_stamped(time, frame, command))
        else:
            self._command_publisher.publish(twist_message(command))

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    # Supervision

    def _watch(self) -> None:
        """Look after the robot in steady time, whatever the control timer does."""
        now = steady.monotonic()
        active = self._supervisor.active
        if active and not self._heard and self._command_publisher.get_subscription_count():
            # What was said before the robot listened is lost, so the first stop starts now.
            self._heard = True
            self._stop_until = now + _STOP_DURATION
        following = self._update_status().state is State.FOLLOWING
        if active and not following and now < self._stop_until:
            self._send(_ZERO, self._now())
        if now >= self._next_diagnostics:
            self._publish_diagnostics()

    def _update_status(self) -> Status:
        """Return the status; tell the robot to stop, and the user, as soon as it changes."""
        now = steady.monotonic()
        status = self._supervisor.status(now)
        if status == self._shown:
            return status
        if self._shown.state is State.FOLLOWING and self._supervisor.active:
            self._stop_until = now + _STOP_DURATION
            self._send(_ZERO, self._now())
        self._shown = status
        text = ": ".join(filter(None, [status.state.value, status.cause]))
        if status.state is State.FAULT:
            self.get_logger().error(f"{text}; {status.remedy}")
        else:
            self.get_logger().info(text)
        self._publish_diagnostics()
        return status

    # Reports

    def _report_learning(self, problem: str) -> None:
        """Say when the Riccati policy takes over from the learned one, and when it hands back."""
        if problem == self._learning_problem:
            return
        if problem:
            self.get_logger().warning(
                f"learning has gone wrong: {problem}; the Riccati policy has taken over where it "
                "did, until learning succeeds"
            )
        else:
            self.get_logger().info("learning succeeds again: the learned policy is back")
        self._learning_problem = problem
        self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        if self._command_publisher is None:
            return
        self._next_diagnostics = steady.monotonic() + 1.0
        values = {"version": __version__}
        if self._follower is not None:
            values["arc_length [m]"] = f"{float(self._follower.arc_length):.3f}"
            values["cost"] = f"{float(self._follower.cost):.6g}"
        problems = (self._path_problem, self._learning_problem)
        self._telemetry.diagnostics(self._now(), self._shown, *problems, values)

    def _publish_configuration(self) -> None:
        if self._command_publisher is None:
            return
        lines = [f"version: {__version__}"]
        if self._path is not None:
            lines.append(f"path: {{digest: {self._path.digest()}, length: {self._path.length!r}}}")
        lines.append("settings:")
        lines += [
            f"  {name}: {yaml_text(value)}" for name, value in flatten(self._settings).items()
        ]
        self._telemetry.configuration("\n".join(lines) + "\n")


def main() -> int:
    """Run the node; return its exit code."""
    return run_node(NODE_NAME, PathFollowerNode)
