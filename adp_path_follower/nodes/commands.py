"""The controller's commands, and that the last one is always to stop."""

from __future__ import annotations

import contextlib
import threading
import time as steady
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.node import Node

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.nodes.conversions import twist_message, twist_stamped
from adp_path_follower.nodes.delivery import EVERY_STEP, LOSSLESS, repeat_until_delivered
from adp_path_follower.nodes.watchdog import WATCH_PERIOD

_STOP_DURATION = 0.5  # [s], steady: how long zero velocity is repeated after a stop, at least ...
_STOP_COUNT = 10  # ... so often: DDS may keep us waiting longer for a listener that stalls
_LAST_WORDS = 3  # zero velocities before the node goes, at least
_LONGEST_WAIT = 0.5  # [s] until a shorter timeout is known
_ZERO = np.zeros(2)


class Commands:
    """Publishes commands; a stop is repeated for a while, then the robot is left to others."""

    def __init__(
        self, node: Node, stamped: bool, lossless: bool, timeout: Callable[[], float]
    ) -> None:
        """Create the publisher, and a thread that stops the robot when a control step hangs.

        Args:
            node: The controller.
            stamped: Whether to publish TwistStamped, else Twist.
            lossless: Keep commands for those who join late.
            timeout: Returns the time that a control step may take [s].

        """
        self.frame = "base_link"
        self._node, self._stamped, self._timeout = node, stamped, timeout
        kind = TwistStamped if stamped else Twist
        self._publisher: Any = node.create_publisher(
            kind, "cmd_vel", LOSSLESS if lossless else EVERY_STEP
        )
        self._heard = False  # whether anybody has listened to commands since the activation
        self._stop_until, self._stops_left = 0.0, 0
        self._busy_since: float | None = None
        self._closed = threading.Event()
        self._watch = threading.Thread(target=self._stop_when_hanging, daemon=True)
        self._watch.start()

    def send(self, command: FloatArray, time: int) -> None:
        """Publish a command [v, w] for a time [ns]."""
        if self._stamped:
            self._publisher.publish(twist_stamped(time, self.frame, command))
        else:
            self._publisher.publish(twist_message(command))

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
            # What was said before the robot listened is lost, so the first stop starts now.
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

    @contextlib.contextmanager
    def control_step(self) -> Iterator[None]:
        """Watch over a control step, from another thread."""
        self._busy_since = steady.monotonic()
        try:
            yield
        finally:
            self._busy_since = None

    def _stop_when_hanging(self) -> None:
        """Publish zero velocity for a while, as soon as a control step takes too long."""
        left = 0.0
        while not self._closed.wait(min(left, _LONGEST_WAIT) if left > 0.0 else WATCH_PERIOD):
            now, since = steady.monotonic(), self._busy_since
            # A step that begins after now cannot be late before that time is over.
            left = self._timeout() - (0.0 if since is None else now - since)
            if -_STOP_DURATION < left <= 0.0:
                self._send_zero()

    def _begin_stop(self) -> None:
        self._stop_until, self._stops_left = steady.monotonic() + _STOP_DURATION, _STOP_COUNT

    def _send_zero(self) -> None:
        self.send(_ZERO, int(self._node.get_clock().now().nanoseconds))
