"""The controller node: odometry and path in, velocity commands out."""

from __future__ import annotations

import contextlib
import math
import time as steady
from collections.abc import Callable
from typing import Any

import numpy as np
from nav_msgs.msg import Odometry
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from adp_path_follower import __version__
from adp_path_follower.bags.configuration import NO_STEP, configuration_text
from adp_path_follower.core.driver import Driver
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.follower import FollowerOutput
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.odometry_check import OdometryCheck
from adp_path_follower.core.schema import update
from adp_path_follower.core.settings import Settings
from adp_path_follower.core.supervisor import State, Status, Supervisor, deviation
from adp_path_follower.nodes.commands import Commands
from adp_path_follower.nodes.conversions import Measurement, MessageError, measurement_of
from adp_path_follower.nodes.parameters import LiveSettings, declare_settings
from adp_path_follower.nodes.path_fitting import Fit, route_of_message
from adp_path_follower.nodes.path_input import PathInput
from adp_path_follower.nodes.path_intake import PathAnswer
from adp_path_follower.nodes.run import Ending
from adp_path_follower.nodes.telemetry import Telemetry
from adp_path_follower.nodes.watchdog import WATCH_PERIOD, Watchdog
from adp_path_follower.nodes.weights import WeightsFiles

NODE_NAME = "path_follower"

_ZERO = np.zeros(2)


class PathFollowerNode(Ending, LifecycleNode):
    """Orchestrate: messages to `PathFollower`, `Supervisor` and back."""

    def __init__(self, fit: Fit = route_of_message) -> None:
        """Declare the parameters; `fit` makes routes of paths, in another thread."""
        super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True)
        self._settings = declare_settings(self, Settings)
        LiveSettings(self, self._settings, self._prepare_settings)
        self._weights = WeightsFiles(self, self._settings, lambda: self._driver)
        self._commands: Commands | None = None
        self._fit = fit
        self._path: PathInput | None = None
        self._watchdog: Watchdog | None = None
        self._entities: list[tuple[Any, Any]] = []
        self._forget_run()
        if self._settings.controller.autostart:
            self.trigger_configure()
            self.trigger_activate()

    def _forget_run(self) -> None:
        """Return to the state before any message."""
        self._driver = Driver(self._settings, self._weights.saved, self.get_logger().warning)
        self._measurement: Measurement | None = None
        self._step_time: int | None = None
        self._last_command: FloatArray = _ZERO
        self._clock_time = 0
        self._shown = Status(State.INACTIVE)
        self._shown_since = 0
        self._next_diagnostics = 0.0
        self._odometry_check = OdometryCheck()
        self._supervisor = Supervisor(self._settings.controller.odom_timeout)

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create publishers, subscriptions, services and timers."""
        controller = self._settings.controller
        lossless = controller.control_trigger == "odometry"
        stamped = controller.enable_stamped_cmd_vel
        self._commands = Commands(
            self, stamped, lossless, lambda: self._settings.controller.odom_timeout
        )
        labels = self._settings.learning.value_basis.labels
        self._telemetry = Telemetry(self, labels, lossless, lambda: self._settings.controller)
        odom = self.create_subscription(
            Odometry, "odom", self._receive_odometry, qos_profile_sensor_data, raw=True
        )
        limit = self.create_subscription(Float64, "speed_limit", self._receive_speed_limit, 1)
        self._path = PathInput(
            self, lambda: self._settings.path, self._follow_path, self._refuse_path, self._fit
        )
        reset = self.create_service(Trigger, "~/reset_learning", self._reset_learning)
        stop = self.create_service(Trigger, "~/stop", self._stop)
        resume = self.create_service(Trigger, "~/resume", self._resume)
        self._watchdog = Watchdog(self, self._watch)
        self._entities = [
            *((self.destroy_subscription, item) for item in (odom, limit)),
            *((self.destroy_service, service) for service in (reset, stop, resume)),
            *self._weights.entities(),
        ]
        if controller.control_trigger == "timer":
            timer = self.create_timer(1.0 / controller.controller_frequency, self._on_timer)
            self._entities.append((self.destroy_timer, timer))
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Allow commands; zero velocity first."""
        self._supervisor.active = True
        assert self._commands is not None  # configured before
        self._commands.activated()
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
        """Tell the robot to stop before the node goes, or gives it over."""
        if self._commands is not None:
            self._commands.last_words()
            self._supervisor.active = False
            self._update_status()  # the last that ~/status and /diagnostics say
            self._telemetry.deliver_status()

    def _destroy_entities(self) -> None:
        for destroy, entity in self._entities:
            destroy(entity)
        self._entities = []
        self._telemetry.destroy(self)
        for part in (self._path, self._commands, self._watchdog):
            if part is not None:
                part.destroy()
        self._path = self._commands = self._watchdog = None

    # Inputs

    def _receive_odometry(self, raw: bytes) -> None:
        now = steady.monotonic()
        try:
            measurement = measurement_of(raw)
        except MessageError as error:
            self._supervisor.odometry_received(now, str(error))
            self._update_status()
            return
        problem = self._odometry_check.problem(
            self._now(),
            measurement.stamp,
            measurement.pose,
            measurement.twist,
            measurement.child_frame,
            self._settings.controller,
        )
        self._supervisor.odometry_received(now, problem)
        if problem:
            self._update_status()
            return
        self._measurement = measurement
        if self._commands is not None:
            self._commands.frame = measurement.child_frame
        assert self._path is not None  # there is no odometry before it is subscribed to
        self._path.odometry_in(measurement.frame)
        if self._settings.controller.control_trigger == "odometry":
            self._control(measurement.stamp)

    def _follow_path(self, found: PathAnswer | None) -> None:
        """Follow another path, or nothing any more."""
        self._driver.follow(None if found is None else found.route)
        if found is None or found.route is None:
            self._supervisor.path_removed()
            self._update_status()
        else:
            self._supervisor.path_received()
            self.get_logger().info(f"new path: {found.text}")
            self._telemetry.markers(self._now(), found.followed_frame, found.route, None)
        self._publish_configuration()

    def _refuse_path(self, problem: str) -> None:
        self.get_logger().error(f"path refused: {problem}")
        self._publish_diagnostics()

    def _receive_speed_limit(self, message: Float64) -> None:
        """Set the parameter speed_limit, so that whoever asks for it sees what holds."""
        try:
            update(self._settings, {"speed_limit": message.data})  # says it better than ROS does
        except SettingsError as error:
            self.get_logger().error(f"speed limit refused: {error}")
            return
        self.set_parameters([Parameter("speed_limit", value=message.data)])

    def _prepare_settings(self, settings: Settings) -> Callable[[], None]:
        """Return what takes over other settings between two steps.

        Raises:
            SettingsError: No policy can be found for them.

        """
        with self._commands.control_step() if self._commands else contextlib.nullcontext():
            change = self._driver.prepared(settings)

        def take_over() -> None:
            self._driver.take_over(change)
            self._settings = settings
            self._supervisor.odom_timeout = settings.controller.odom_timeout
            self._publish_configuration()

        return take_over

    def _reset_learning(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self._driver.reset_learning()
        self._publish_configuration()
        response.success, response.message = True, "weights are the initial ones again"
        return response

    def _stop(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._supervisor.stop()
        if self._commands is not None:
            self._commands.stop()
        self._update_status()
        response.success, response.message = True, "stopped; ~/resume goes on"
        return response

    def _resume(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Go on from where the robot is now: it may have been carried."""
        self._supervisor.resume()
        if self._driver.restart():
            self._publish_configuration()
        response.success, response.message = True, self._update_status().state.value
        return response

    # Control

    def _on_timer(self) -> None:
        self._supervisor.tick(steady.monotonic())
        self._control(self._now())

    def _control(self, time: int) -> None:
        """Command for a time [ns], then learn: what is learned is for the next command."""
        self._command(time)
        if self._commands is not None:
            with self._commands.control_step():
                self._driver.learn()

    def _command(self, time: int) -> None:
        """Compute and publish the command for a time [ns]."""
        if self._update_status().state is not State.FOLLOWING:
            return
        assert self._measurement is not None  # there is no FOLLOWING without odometry
        assert self._commands is not None  # nor before the node is configured
        if time == self._step_time:  # the same odometry again: so is the answer
            self._commands.send(self._last_command, time)
            return
        pose = self._measurement.pose_at(time)
        begun = steady.monotonic()
        try:
            with self._commands.control_step():
                output = self._driver.command_for(pose, time)
        except SettingsError as error:
            self._supervisor.command_refused(str(error))
            self._update_status()
            return
        problem = self._command_problem(output, steady.monotonic() - begun)
        if problem:
            self._supervisor.command_refused(problem)
            self._update_status()
            return
        self._last_command, self._step_time = output.command, time
        too_far = deviation(output.error, self._settings.controller)
        if too_far:
            self._supervisor.deviated(too_far)
            self._update_status()
        else:
            self._commands.send(output.command, time)
        follower = self._driver.follower
        assert follower is not None  # the step has made it
        if self._telemetry.learning(follower.learning_problem):
            self._publish_diagnostics()
        assert self._path is not None  # nor without a path
        assert self._path.followed is not None
        frame, route = self._path.followed.followed_frame, self._driver.route
        self._telemetry.step(time, frame, pose, output, float(follower.cost))
        if route is not None:
            self._telemetry.markers(time, frame, route, output)
        if self._driver.at_goal:
            self._supervisor.goal_reached()
        elif follower.goal.problem:
            self._supervisor.goal_missed(follower.goal.problem)

    def _command_problem(self, output: FollowerOutput, elapsed: float) -> str:
        """Return why a command must not be sent, empty if it may."""
        if not all(map(math.isfinite, output.command.tolist())):
            self._driver.reset_learning()
            self._publish_configuration()
            return "the learner's command is not finite; learning was reset"
        if elapsed > self._settings.controller.odom_timeout:
            return f"a control step took {elapsed:.2f} s"
        return ""

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    # Supervision

    def _watch(self) -> float:
        """Look after the robot, whatever the control timer does; return when to do so again [s]."""
        if self._path is not None:
            self._path.retry()
        clock_time = self._now()
        by_timer = self._settings.controller.control_trigger == "timer"
        self._supervisor.clock_missing(by_timer and clock_time == 0)
        if clock_time < self._clock_time and by_timer:
            self._supervisor.command_refused("the clock went back")
        self._clock_time = clock_time
        following = self._update_status().state is State.FOLLOWING
        if self._commands is not None and self._supervisor.active and not following:
            self._commands.repeat_stop()
        if steady.monotonic() >= self._next_diagnostics:
            self._publish_diagnostics()
        return self._supervisor.patience(steady.monotonic()) if following else WATCH_PERIOD

    def _update_status(self) -> Status:
        """Return the status; tell the robot to stop, and the user, as soon as it changes."""
        now = steady.monotonic()
        status = self._supervisor.status(now)
        if status == self._shown:
            return status
        if self._watchdog is not None:
            self._watchdog.hurry()
        leaves = self._shown.state is State.FOLLOWING and self._supervisor.active
        if leaves and self._commands is not None:
            self._commands.stop()
            self._last_command = _ZERO
            if self._driver.stopped():
                self._publish_configuration()
        same_state, self._shown = status.state is self._shown.state, status
        if same_state and now < self._next_diagnostics:
            return status  # a cause that changes with every message is no news with each
        if not same_state:
            self._shown_since = self._now()
        text = ": ".join(filter(None, [status.state.value, status.cause]))
        if status.state is State.FAULT:
            self.get_logger().error(f"{text}; {status.remedy}")
        else:
            self.get_logger().info(text)
        self._publish_diagnostics()
        return status

    # Reports

    def _publish_diagnostics(self) -> None:
        if self._commands is None:
            return
        self._next_diagnostics = steady.monotonic() + 1.0
        values = {"version": __version__}
        problem = "" if self._path is None else self._path.problem
        if self._driver.follower is not None:
            values["arc_length [m]"] = f"{float(self._driver.follower.arc_length):.3f}"
            values["cost"] = f"{float(self._driver.follower.cost):.6g}"
        self._telemetry.diagnostics(self._now(), self._shown, self._shown_since, problem, values)

    def _publish_configuration(self) -> None:
        if self._commands is None:
            return
        driver, after = self._driver, NO_STEP if self._step_time is None else self._step_time
        path = None if self._path is None else self._path.followed
        self._telemetry.configuration(
            configuration_text(
                *(driver.settings, driver.route, after),
                *(driver.learning_resets, driver.restarts, driver.stops),
                *(self._weights.digest, () if path is None else path.transform),
            )
        )
