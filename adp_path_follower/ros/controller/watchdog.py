"""Look after the robot in steady time, as seldom as is safe."""

from collections.abc import Callable

from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node

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
