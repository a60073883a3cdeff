"""The controller node: odometry and path in, velocity commands out."""

import math
import time as steady
from collections.abc import Callable

import numpy as np
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.driving.output import FollowerOutput
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.safety.odometry_check import Measurement, OdometryProblem, stamp_problem
from adp_path_follower.core.safety.supervisor import State, Status, Supervisor, deviation
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.messages.configuration import NO_STEP, configuration_text
from adp_path_follower.ros.controller.commands import WATCH_PERIOD, Commands, Watchdog
from adp_path_follower.ros.controller.far_values import FarValues
from adp_path_follower.ros.controller.follow_path_action import FollowPathAction, Site
from adp_path_follower.ros.controller.odometry_input import OdometryInput
from adp_path_follower.ros.controller.parts import ControllerParts
from adp_path_follower.ros.controller.path_input import PathAnswer, PathInput
from adp_path_follower.ros.controller.path_process import Fit, route_of_message
from adp_path_follower.ros.controller.speed_limit_input import SpeedLimitInput
from adp_path_follower.ros.controller.telemetry import StatusLog, Telemetry
from adp_path_follower.ros.controller.weights import WeightsFiles
from adp_path_follower.ros.runtime.parameters import LiveSettings, declare_settings
from adp_path_follower.ros.runtime.path_frame import PathFrame
from adp_path_follower.ros.runtime.run import Ending
from adp_path_follower.ros.runtime.services import (
    defend_services,
    told_if_it_fails,
    trigger_services,
)

NODE_NAME = "path_follower"

_ZERO = np.zeros(2)


class PathFollowerNode(Ending, LifecycleNode):
    """Connects messages with `Driver` and `Supervisor`."""

    def __init__(self, fit: Fit = route_of_message) -> None:
        """Declare the parameters; `fit` makes routes of paths, in another thread."""
        super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True)
        defend_services(self)
        self.settings = declare_settings(self, Settings)
        LiveSettings(self, self.settings, self._prepare_settings)
        self._values = FarValues(self, lambda: self.settings, self._prepare_settings)
        self._weights = WeightsFiles(self, self.settings, lambda: self.driver)
        self._fit = fit
        self._parts: ControllerParts | None = None
        self._site = Site(
            settings=lambda: self.settings.navigation,
            status=lambda: self.status,
            active=lambda: self._supervisor.active,
            driver=lambda: self.driver,
            speed=lambda: self.parts.odometry.speed,
            pose=lambda frame: self.parts.frame.seen_in(frame, self.parts.odometry.pose),
            hurry=lambda: self.parts.watchdog.hurry(),
        )
        self._supervisor = Supervisor(self.settings.controller.odom_timeout)
        self._forget_run()
        if self.settings.controller.autostart:
            self.trigger_configure()
            self.trigger_activate()

    def _forget_run(self) -> None:
        """Return to the state before any message."""
        log = self.get_logger()
        settings = self._values.drivable(self.settings)
        self.driver = Driver(settings, self._weights.saved, log.warning, tell_start=log.info)
        self._step_time: int | None = None
        self._last_command: FloatArray = _ZERO
        self._clock_time = 0
        self.status = Status(State.INACTIVE)
        self._status_log = StatusLog(log)
        self._shown_since = 0
        self._next_diagnostics = 0.0
        self._supervisor = self._supervisor.renewed()

    @property
    def parts(self) -> ControllerParts:
        """Return what the node is made of, from `on_configure` to `on_cleanup`."""
        assert self._parts is not None  # whoever asks was created with them
        return self._parts

    # Lifecycle

    @told_if_it_fails
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create publishers, subscriptions, services and timers."""
        controller = self.settings.controller
        lossless = controller.control_trigger == "odometry"
        labels = self.settings.learning.value_basis.labels
        frame = PathFrame(self, lambda: self.settings.navigation)
        path = PathInput(
            *(self, lambda: self.settings.path, self._follow_path, self._refuse_path),
            *(lambda: self.parts.action.path_on_topic(), frame, self._fit),
        )
        limit = SpeedLimitInput(self, lambda: self.settings, self._answer_speed_limit)
        self._parts = ControllerParts(
            Commands(self, lambda: self.settings.controller),
            Telemetry(self, labels, lossless, lambda: self.settings.controller),
            OdometryInput(self, lambda: self.settings, self._take_odometry, self._refuse_odometry),
            frame,
            path,
            FollowPathAction(self, path, self._site),
            limit,
            Watchdog(self, self._watch),
            self._weights.entities(),
        )
        acts = {"reset_learning": self._reset_learning, "stop": self._stop, "resume": self._resume}
        self._parts.entities.extend(trigger_services(self, acts))
        if controller.control_trigger == "timer":
            timer = self.create_timer(1.0 / controller.controller_frequency, self._on_timer)
            self._parts.entities.append((self.destroy_timer, timer))
        return super().on_configure(state)

    @told_if_it_fails
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Allow commands; zero velocity first."""
        self.parts.commands.activated()
        result = super().on_activate(state)
        self.get_logger().info("active: following as soon as there are odometry and a path")
        self._supervisor.active = True  # when nothing can fail any more
        return result

    @told_if_it_fails
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the robot and send no more commands."""
        self.last_words()
        return super().on_deactivate(state)

    @told_if_it_fails
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the robot and forget path, odometry and what was learned."""
        self.last_words()
        self.parts.destroy()
        self._parts = None
        self._forget_run()
        return super().on_cleanup(state)

    @told_if_it_fails
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the robot and end the node."""
        self.last_words()
        self.finished = True
        return super().on_shutdown(state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the node, and stop the robot: nobody knows how much of a transition was made."""
        self._supervisor.active = False
        self.finished = self.failed = True
        return super().on_error(state)

    def last_words(self) -> None:
        """Tell the robot to stop before the node goes, or gives it over."""
        self._supervisor.active = False
        if self._parts is None:
            return
        self._parts.commands.last_words()
        self._parts.action.deactivated()
        self._note_stop()
        self._update_status()  # the last that ~/status and /diagnostics say
        self._parts.telemetry.deliver_status()

    # Inputs

    def _refuse_odometry(self, problem: OdometryProblem) -> None:
        self._supervisor.odometry_received(steady.monotonic(), problem)
        self._update_status()

    def _take_odometry(self, measurement: Measurement) -> None:
        self._supervisor.odometry_received(steady.monotonic())
        parts = self.parts
        parts.commands.frame = measurement.child_frame
        parts.frame.odometry_in(measurement.frame, measurement.child_frame)
        if self.settings.controller.control_trigger == "odometry":
            self._control(measurement.stamp)

    def _follow_path(self, found: PathAnswer | None) -> None:
        """Follow another path, or nothing any more."""
        self.driver.follow(None if found is None else found.route)
        parts = self.parts
        if found is None or found.route is None:
            self._supervisor.path_removed()
            parts.frame.accept()
            self._update_status()
        else:
            self._supervisor.path_received()
            self.get_logger().info(f"new path: {found.text}")
            parts.action.path_followed(found)
            parts.telemetry.markers(self._now(), found.frame, found.route, None)
        self._publish_configuration()

    def _refuse_path(self, found: PathAnswer) -> None:
        self.get_logger().error(f"path rejected: {self.parts.path.problem}")
        self._publish_diagnostics()
        self.parts.action.path_refused(found)

    def _answer_speed_limit(self, problem: str) -> None:
        """Let the robot stand while the last limit cannot hold: who sent it may want that."""
        self._supervisor.limit_problem = problem
        self._update_status()

    def _prepare_settings(self, settings: Settings) -> Callable[[], None]:
        """Return what takes over settings between steps; SettingsError if no policy is found."""
        change = self.driver.prepared(self._values.drivable(settings))

        def take_over() -> None:
            self.driver.take_over(change)
            self.settings = settings
            self._supervisor.odom_timeout = settings.controller.odom_timeout
            self._publish_configuration()

        return take_over

    def _reset_learning(self) -> str:
        self.driver.reset_learning()
        self._publish_configuration()
        return "weights are the initial ones again"

    def _stop(self) -> str:
        self._supervisor.stop()
        if self._supervisor.active:
            self.parts.commands.stop()
        self._update_status()
        return "stopped; ~/resume goes on"

    def _resume(self) -> str:
        """Go on from where the robot is now: it may have been carried."""
        self._supervisor.resume()
        self.parts.frame.accept()
        if self.driver.restart():
            self._publish_configuration()
        return self._update_status().state.value

    # Control

    def _on_timer(self) -> None:
        self._supervisor.tick_time = steady.monotonic()
        self._control(self._now())

    def _control(self, time: int) -> None:
        """Command for a time [ns], then learn: what is learned is for the next command."""
        self._command(time)
        self.driver.learn()

    def _command(self, time: int) -> None:
        """Compute and publish the command for a time [ns]."""
        self._supervisor.transform_problem = self.parts.path.missing_frame()
        if self._update_status().state is not State.FOLLOWING:
            return
        parts, measurement = self.parts, self.parts.odometry.measurement
        assert measurement is not None  # there is no FOLLOWING without odometry,
        assert parts.path.followed is not None  # nor without a path
        frame = parts.path.followed.frame
        if time == self._step_time:  # the same odometry again: so is the answer
            parts.commands.send(self._last_command, time)
            return
        problem = stamp_problem(time, measurement.stamp, self.settings.controller)
        if problem:
            self._refuse_command(problem)
            return
        pose, motion = measurement.pose_at(time), measurement.motion_at(time)
        jumped = parts.frame.correct(pose, frame)
        if jumped:
            self._supervisor.deviation = jumped
            self._update_status()
            return
        pose = parts.frame.located(pose, float(motion[0]), frame)
        try:
            output = self.driver.command_for(pose, time, motion)
        except SettingsError as error:
            self._note_step(time, frame, (pose, motion))
            self._refuse_command(str(error))
            return
        if not all(map(math.isfinite, output.command.tolist())):
            self._note_step(time, frame, (pose, motion))
            self.driver.reset_learning()
            self._publish_configuration()
            self._refuse_command("the learner's command is not finite; learning was reset")
            return
        self._last_command, self._step_time = output.command, time
        too_late = parts.commands.take_lateness()
        too_far = deviation(output.error, self.settings.controller)
        if too_late:
            self._refuse_command(too_late)
        elif too_far:
            self._supervisor.deviation = too_far
            self._update_status()
        else:
            parts.commands.send(output.command, time)
        self._tell(time, frame, (pose, motion), output)

    def _refuse_command(self, problem: str) -> None:
        self._supervisor.command_problem = problem
        self._update_status()

    def _note_step(self, time: int, frame: str, measured: tuple[FloatArray, FloatArray]) -> None:
        """Note a step without a command, as replays take that step, too."""
        self._last_command, self._step_time = _ZERO, time
        self.parts.telemetry.measured(time, frame, measured)

    def _tell(
        self, time: int, frame: str, measured: tuple[FloatArray, FloatArray], output: FollowerOutput
    ) -> None:
        """Tell what a step at a time [ns], pose and motion (3,) found; see if it is the last."""
        parts, follower, route = self.parts, self.driver.follower, self.driver.route
        assert follower is not None  # the step has made it
        assert route is not None
        if parts.telemetry.learning(follower.learning_problem):
            self._publish_diagnostics()
        parts.telemetry.step(time, frame, measured, output, float(follower.cost))
        parts.telemetry.markers(time, frame, route, output)
        if self.driver.at_goal:
            self._supervisor.goal_reached = True
            parts.frame.accept()
        elif follower.goal.problem:
            self._supervisor.goal_problem = follower.goal.problem

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _watch(self) -> float:
        """Look after the robot, whatever the control timer does; return when to do so again [s]."""
        parts = self.parts
        parts.path.retry()
        clock_time = self._now()
        by_timer = self.settings.controller.control_trigger == "timer"
        self._supervisor.clock_missing = by_timer and clock_time == 0
        if clock_time < self._clock_time and by_timer:
            self._supervisor.command_problem = "the clock went back"
        self._clock_time = clock_time
        self._supervisor.transform_problem = parts.path.missing_frame()
        pose = parts.odometry.pose if self.status.state is State.FOLLOWING else None
        self._supervisor.look_for_progress(1e-9 * clock_time, pose, self.settings.navigation)
        following = self._update_status().state is State.FOLLOWING
        parts.action.look()
        if self._supervisor.active and not following:
            parts.commands.repeat_stop()
        if steady.monotonic() >= self._next_diagnostics:
            parts.speed_limit.match()
            self._publish_diagnostics()
        return self._supervisor.patience(steady.monotonic()) if following else WATCH_PERIOD

    def _update_status(self) -> Status:
        """Return the status; tell the robot to stop, and the user, as soon as it changes."""
        now = steady.monotonic()
        status = self._supervisor.status(now)
        if status != self.status:
            self._change_status(status)
        if self._status_log.tell(status, now):
            self._publish_diagnostics()
        return status

    def _change_status(self, status: Status) -> None:
        if self._parts is not None:
            self._parts.watchdog.hurry()
        if self.status.state is State.FOLLOWING and self._supervisor.active:
            self.parts.commands.stop()
            self._note_stop()
        if status.state is not self.status.state:
            self._shown_since = self._now()
        self.status = status

    def _note_stop(self) -> None:
        """Remember that the robot was told to stop: its next command begins at rest."""
        self._last_command = _ZERO
        if self.driver.stopped():
            self._publish_configuration()

    # Reports

    def _publish_diagnostics(self) -> None:
        if self._parts is None:
            return
        self._next_diagnostics = steady.monotonic() + 1.0
        self._parts.telemetry.diagnostics(
            *(self._now(), self.status, self._shown_since, self._parts.path.problem),
            *(self.driver, self._parts.topic_problem(self)),
        )

    def _publish_configuration(self) -> None:
        if self._parts is None:
            return
        driver, after = self.driver, NO_STEP if self._step_time is None else self._step_time
        text = configuration_text(
            driver.settings, driver.route, after, driver.counts, self._weights.digest
        )
        self._parts.telemetry.configuration(text)
