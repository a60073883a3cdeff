"""The controller's commands, and that the last one is always to stop."""

import threading
import time as steady
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import ControllerSettings
from adp_path_follower.ros.runtime.conversions import twist_message, twist_stamped
from adp_path_follower.ros.runtime.qos import EVERY_STEP, LOSSLESS, repeat_until_delivered

WATCH_PERIOD = 0.02  # [s], where something is wrong, or is being waited for

_CALM_PERIOD = 0.1  # [s], where all is well: a robot drives with every wake less
_LEAST_PERIOD = 0.001  # [s], for what is due now


class Watchdog:
    """A steady timer whose period is what is left until something may be wrong."""

    def __init__(self, node: Node, look: Callable[[], float]) -> None:
        """Start; `look` returns the time to its next call [s], sooner if a ROS clock goes back."""
        self._node, self._look = node, look
        self._period = WATCH_PERIOD
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(WATCH_PERIOD, self._on_timer, clock=steady)
        back = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True
        )
        self._jumps = node.get_clock().create_jump_callback(
            back, post_callback=lambda _: self.hurry()
        )

    def hurry(self) -> None:
        """Look again soon, because something has changed."""
        self._set_period(WATCH_PERIOD)

    def destroy(self) -> None:
        """End the timer."""
        self._jumps.unregister()
        self._node.destroy_timer(self._timer)

    def _on_timer(self) -> None:
        self._set_period(min(max(self._look(), _LEAST_PERIOD), _CALM_PERIOD))

    def _set_period(self, period: float) -> None:
        if period != self._period:
            self._period = period
            self._timer.timer_period_ns = round(1e9 * period)
            self._timer.reset()  # counts from now on


_STOP_DURATION = 0.5  # [s], steady: how long zero velocity is repeated after a stop, at least ...
_STOP_COUNT = 10  # ... so often: DDS may keep us waiting longer for a listener that stalls
_LAST_WORDS = 3  # zero velocities before the node goes, at least
_MOST_SILENCE = 0.5  # [s] beyond a period of the control timer, however long odometry may be silent
_LONGEST_WAIT = 0.5  # [s] until a shorter timeout is known
_ZERO = np.zeros(2)


class Commands:
    """Publishes commands; a stop is repeated for a while, then the robot is left to others.

    A thread stops the robot when no command follows one that moves it, whatever holds the node up.
    """

    def __init__(self, node: Node, controller: Callable[[], ControllerSettings]) -> None:
        """Create the publisher, which serves late subscribers in lock-step; start the thread."""
        self.frame = "base_link"
        self._node, self._controller = node, controller
        self._stamped = controller().enable_stamped_cmd_vel
        self._publisher: Any = node.create_publisher(
            TwistStamped if self._stamped else Twist,
            "cmd_vel",
            LOSSLESS if controller().control_trigger == "odometry" else EVERY_STEP,
        )
        self._heard = False  # whether anybody has listened to commands since the activation
        self._stop_until, self._stops_left = 0.0, 0
        self._moved_at: float | None = None  # when the last command was sent, if it moves
        self._was_late = False
        self._closed = threading.Event()
        self._watch = threading.Thread(target=self._stop_when_silent, daemon=True)
        self._watch.start()

    def send(self, command: FloatArray, time: int) -> None:
        """Publish a command [v, w] for a time [ns]."""
        self._moved_at = steady.monotonic() if command.any() else None
        self._publish(command, time)

    def _timeout(self) -> float:
        """Return how long the robot may go on with one command [s]."""
        controller = self._controller()
        if controller.control_trigger == "odometry":
            return controller.odom_timeout
        return min(controller.odom_timeout, 1.0 / controller.controller_frequency + _MOST_SILENCE)

    def take_lateness(self) -> str:
        """Return why the robot was stopped although it was to drive, once; empty if it was not."""
        late, self._was_late = self._was_late, False
        return f"no command for more than {self._timeout():g} s" if late else ""

    def stop(self) -> None:
        """Publish zero velocity, now and for a while."""
        self._begin_stop()
        self._send_zero()

    def activated(self) -> None:
        """Begin with a stop, for those who listen and for those who come."""
        self._heard = False
        self._send_zero()

    def repeat_stop(self) -> None:
        """Publish zero velocity again, if the last stop is not long ago."""
        if not self._heard and self._publisher.get_subscription_count():
            # A command from before the robot listened is lost, so the first stop starts now.
            self._heard = True
            self._begin_stop()
        if steady.monotonic() < self._stop_until or self._stops_left > 0:
            self._stops_left -= 1
            self._send_zero()

    def last_words(self) -> None:
        """Publish zero velocity three times, and on, not for long, until it was delivered."""
        repeat_until_delivered(self._publisher, self._send_zero, _LAST_WORDS)

    def destroy(self) -> None:
        """End the thread and destroy the publisher."""
        self._closed.set()
        self._watch.join()
        self._node.destroy_publisher(self._publisher)

    def _stop_when_silent(self) -> None:
        """Publish zero velocity for a while, as soon as the next command is late."""
        left = 0.0
        while not self._closed.wait(min(left, _LONGEST_WAIT) if left > 0.0 else WATCH_PERIOD):
            now, since = steady.monotonic(), self._moved_at
            # A command that is sent after now cannot be old before that time is over.
            left = self._timeout() - (0.0 if since is None else now - since)
            if left <= 0.0:
                self._was_late = True
            if -_STOP_DURATION < left <= 0.0:
                self._publish(_ZERO, self._now())

    def _publish(self, command: FloatArray, time: int) -> None:
        if self._stamped:
            self._publisher.publish(twist_stamped(time, self.frame, command))
        else:
            self._publisher.publish(twist_message(command))

    def _now(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

    def _begin_stop(self) -> None:
        self._stop_until, self._stops_left = steady.monotonic() + _STOP_DURATION, _STOP_COUNT
        self._was_late = False  # it was stopped anyway

    def _send_zero(self) -> None:
        self.send(_ZERO, self._now())
