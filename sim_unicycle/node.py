"""The simulator node: velocity commands in, odometry and clock out."""

import math
import time as steady
from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock as ClockMessage

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.ros.runtime.conversions import (
    NANOSECONDS,
    odometry_message,
    quaternion_of,
    stamp_nanoseconds,
)
from adp_path_follower.ros.runtime.parameters import LiveSettings, declare_settings
from adp_path_follower.ros.runtime.qos import EVERY_STEP, LOSSLESS
from adp_path_follower.ros.runtime.run import Ending, run_node
from adp_path_follower.ros.runtime.services import trigger_services
from sim_unicycle.fault_script import read_fault_script
from sim_unicycle.odometry import Reading
from sim_unicycle.settings import FrameSettings, SimulatorSettings, with_robot
from sim_unicycle.unicycle import Unicycle

NODE_NAME = "unicycle_sim"

_DISCOVERY_PERIOD = 0.1  # [s], steady
_DELIVERY_TIMEOUT = 5.0  # [s]
_RESEND_PERIOD = 0.1  # [s], steady: how long lock-step waits before it repeats its odometry
_REMINDER = 5.0  # [s], steady: how long it waits before it tells the user
_SILENT_STEPS = 100  # without odometry, that lock-step takes at once
_TF_DEPTH = 100
_ZERO = np.zeros(2)


class SimulatorNode(Ending, Node):
    """A unicycle in simulated time.

    In lock-step, time stands still until a command arrives that answers the last odometry: a
    TwistStamped with its stamp, or any Twist. Before the first answer no /clock is published, so
    that the zero velocities of a controller that starts (their stamp is 0) are no answers. Where
    odometry is delayed or lost, it takes the next step without an answer.
    """

    def __init__(self) -> None:
        super().__init__(NODE_NAME, automatically_declare_parameters_from_overrides=True)
        self._settings = declare_settings(self, SimulatorSettings, with_robot)
        LiveSettings(self, self._settings, self._prepare_settings)
        simulation = self._settings.simulation
        self._script = read_fault_script(simulation.fault_script)
        message_fault = self._script.changes_messages()
        if simulation.lockstep and message_fault:
            raise SettingsError(
                f"fault_script changes '{message_fault}', but lock-step waits for an answer to "
                "every odometry message: set lockstep to false"
            )
        self._script_start: int | None = None  # the time of the first command to move [ns]
        self._chance = np.random.default_rng(self._settings.plant.seed)
        self._period = round(NANOSECONDS / simulation.rate)  # [ns]
        self._own_clock = simulation.publish_clock or simulation.lockstep
        self._robot = self._new_robot()
        self._command: FloatArray = _ZERO
        self._command_time = 0
        self._start_time = self._period if self._own_clock else self.get_clock().now().nanoseconds
        self._time = self._start_time  # [ns]
        self._asked = 0  # stamp of the last odometry [ns]
        self._odometry_messages: list[Odometry] = []
        self._answered = False  # whether lock-step has had its first answer
        self._sent_at = self._reminded_at = steady.monotonic()

        qos = LOSSLESS if simulation.lockstep else EVERY_STEP
        self._odometry = self.create_publisher(Odometry, "odom", qos)
        self._ground_truth = self.create_publisher(Odometry, "ground_truth", qos)
        self._transforms = Transforms(self, self._settings.frames.publish_tf)
        self._clock_publisher = None
        if self._own_clock:
            self._clock_publisher = self.create_publisher(ClockMessage, "/clock", 10)
        self._command_type = TwistStamped
        self._command_subscription = self._subscribe_commands()
        steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_DISCOVERY_PERIOD, self._match_command_type, clock=steady_clock)
        trigger_services(self, {"reset": self._reset})
        period = self._period / NANOSECONDS / simulation.real_time_factor
        if simulation.lockstep:
            self._publish(self._settings)
            period = 0.5 * _RESEND_PERIOD
        self.create_timer(
            period, self._resend if simulation.lockstep else self._tick, clock=steady_clock
        )
        mode = "in lock-step" if simulation.lockstep else f"at {simulation.rate:g} Hz"
        self.get_logger().info(f"simulating {mode}")

    def last_words(self) -> None:
        """Wait briefly until a recorder has received everything."""
        if self._settings.simulation.lockstep:
            for publisher in (self._ground_truth, self._odometry):
                publisher.wait_for_all_acked(Duration(seconds=_DELIVERY_TIMEOUT))

    def _new_robot(self) -> Unicycle:
        start = self._settings.start
        return Unicycle(np.array([start.x, start.y, start.theta]), self._settings.plant)

    def _prepare_settings(self, settings: SimulatorSettings) -> Callable[[], None]:
        def take_over() -> None:
            self._settings = settings

        return take_over

    def _reset(self) -> str:
        self._robot = self._new_robot()
        self._command, self._script_start = _ZERO, None
        return "robot is at its start again"

    # Commands

    def _subscribe_commands(self) -> Subscription:
        stamped = self._command_type is TwistStamped
        receive = self._receive_stamped if stamped else self._receive_twist
        return self.create_subscription(self._command_type, "cmd_vel", receive, EVERY_STEP)

    def _match_command_type(self) -> None:
        """Subscribe with the type that is published; one DDS participant cannot use both."""
        offered = {info.topic_type for info in self.get_publishers_info_by_topic("cmd_vel")}
        other = Twist if self._command_type is TwistStamped else TwistStamped
        if offered == {f"geometry_msgs/msg/{other.__name__}"}:
            self.destroy_subscription(self._command_subscription)
            self._command_type = other
            self._command_subscription = self._subscribe_commands()

    def _receive_stamped(self, message: TwistStamped) -> None:
        self._receive(message.twist, stamp_nanoseconds(message.header) == self._asked)

    def _receive_twist(self, message: Twist) -> None:
        self._receive(message, True)

    def _receive(self, twist: Twist, answers: bool) -> None:
        command = np.array([twist.linear.x, twist.angular.z])
        if not np.isfinite(command).all():
            self.get_logger().error(f"command rejected: {command.tolist()} is not finite")
            return
        lockstep = self._settings.simulation.lockstep
        if lockstep and not answers:
            return
        if self._script_start is None and command.any():
            self._script_start = self._time
        self._command, self._command_time = command, self._time
        if lockstep:
            self._answered = True
            self._advance_to_odometry()

    # Time

    def _tick(self) -> None:
        """Advance simulated time with the steady clock."""
        if self._own_clock:
            self._advance(self._period)
        else:
            self._advance(self.get_clock().now().nanoseconds - self._time)

    def _resend(self) -> None:
        """Repeat an odometry that was not answered: it, or its answer, may have been lost."""
        now = steady.monotonic()
        if now - self._sent_at < _RESEND_PERIOD:
            return
        if not self._odometry_messages:  # more than the steps that are taken at once
            self._advance_to_odometry()
            return
        self._sent_at = now
        self._send_state()
        if now - self._reminded_at > _REMINDER:
            self._reminded_at = now
            self.get_logger().warning(
                "lock-step is waiting for a command with the stamp of the last odometry: is a "
                "controller running, has it a path, and is its control_trigger 'odometry'?"
            )

    def _advance_to_odometry(self) -> None:
        """Move the robot until there is odometry to answer, for a bounded number of steps."""
        for _ in range(_SILENT_STEPS):
            self._advance(self._period)
            if self._odometry_messages or self.finished:
                break

    def _advance(self, duration: int) -> None:
        """Move the robot for a time [ns] and publish where it is."""
        simulation = self._settings.simulation
        if duration <= 0:  # the clock that it follows stands still, or went back
            return
        if self._time + duration > self._start_time + simulation.duration * NANOSECONDS + 1:
            self.finished = True
            return
        settings = self._settings
        if self._script_start is not None:
            elapsed = (self._time - self._script_start) / NANOSECONDS
            settings = self._script.settings_at(settings, elapsed)
        age = (self._time - self._command_time) / NANOSECONDS
        command = self._command if age < settings.simulation.command_timeout else _ZERO
        self._robot.plant = settings.plant
        self._robot.step(command, duration / NANOSECONDS)
        self._time += duration
        self._reminded_at = steady.monotonic()
        self._publish(settings)

    def _publish(self, settings: SimulatorSettings) -> None:
        self._sent_at = steady.monotonic()
        runs = self._answered or not settings.simulation.lockstep
        faults, robot = settings.message_faults, self._robot
        time = published_time(self._time, settings)
        if self._clock_publisher is not None and runs and not faults.clock_stops:
            seconds, nanoseconds = divmod(time, NANOSECONDS)
            self._clock_publisher.publish(
                ClockMessage(clock=Time(sec=seconds, nanosec=nanoseconds))
            )
        frames = settings.frames.odom_frame, settings.frames.base_frame
        self._frames = settings.frames
        # Kept, so that lock-step repeats the same messages: the same noise.
        self._truth_message = odometry_message(time, robot.pose, robot.twist, frames)
        self._odometry_messages = []
        for reading in robot.arrived:
            measured_at = self._time - round((robot.time - float(reading.time)) * NANOSECONDS)
            self._odometry_messages.append(odometry_of(reading, measured_at, settings))
            if self._chance.random() < faults.odometry_duplicate:
                self._odometry_messages.append(self._odometry_messages[-1])
        if self._odometry_messages:
            self._asked = stamp_nanoseconds(self._odometry_messages[-1].header)
        self._send_state()

    def _send_state(self) -> None:
        self._ground_truth.publish(self._truth_message)
        elapsed = (self._time - self._start_time) / NANOSECONDS
        for message in self._odometry_messages:
            self._transforms.publish(message, self._frames, elapsed)
            self._odometry.publish(message)


class Transforms:
    """Publishes map → odom and odom → base on /tf, where `tf2_msgs` is installed."""

    def __init__(self, node: Node, wanted: bool) -> None:
        self._publisher: Any = None
        if not wanted:
            return
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            return
        self._message = TFMessage
        self._publisher = node.create_publisher(TFMessage, "/tf", _TF_DEPTH)

    def publish(self, odometry: Odometry, settings: FrameSettings, elapsed: float) -> None:
        """Publish the transforms that belong to odometry, a time [s] after the start."""
        if self._publisher is None:
            return
        robot = TransformStamped(header=odometry.header, child_frame_id=odometry.child_frame_id)
        place, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
        robot.transform.translation.x, robot.transform.translation.y = place.x, place.y
        robot.transform.rotation = turn
        found = [robot]
        if settings.map_frame:
            found.append(_map(odometry, settings, elapsed))
        self._publisher.publish(self._message(transforms=found))


def _map(odometry: Odometry, settings: FrameSettings, elapsed: float) -> TransformStamped:
    """Return the place of odometry's frame in the map, a time [s] after the start."""
    place = np.array(settings.map_offset) + elapsed * np.array(settings.map_drift)
    found = TransformStamped(child_frame_id=odometry.header.frame_id)
    found.header.stamp, found.header.frame_id = odometry.header.stamp, settings.map_frame
    found.transform.translation.x, found.transform.translation.y = place[:2].tolist()
    found.transform.rotation = quaternion_of(float(place[2]))
    return found


def main() -> int:
    """Run the node; return its exit code."""
    return run_node(NODE_NAME, SimulatorNode)


def _corrupt(message: Odometry, fault: str) -> None:
    """Spoil the values of a message as `odometry_corruption` says."""
    if fault == "nan":
        message.pose.pose.position.x = math.nan
    elif fault == "infinite":
        message.pose.pose.position.x = math.inf
    elif fault == "zero_quaternion":
        message.pose.pose.orientation.z = message.pose.pose.orientation.w = 0.0


def published_time(time: int, settings: SimulatorSettings) -> int:
    """Return the time on /clock [ns] at a simulated time [ns]."""
    return max(1, time + round(NANOSECONDS * settings.message_faults.clock_offset))


def odometry_of(reading: Reading, time: int, settings: SimulatorSettings) -> Odometry:
    """Return the message of a reading at a simulated time [ns], with the faults of the settings."""
    faults, own = settings.message_faults, settings.frames
    frames = (
        faults.reported_odom_frame or own.odom_frame,
        faults.reported_base_frame or own.base_frame,
    )
    stamp = published_time(time, settings) + round(NANOSECONDS * faults.odometry_stamp_offset)
    pose = reading.pose + np.array(faults.odometry_offset)
    message = odometry_message(max(0, stamp), pose, reading.twist, frames)
    _corrupt(message, faults.odometry_corruption)
    return message
