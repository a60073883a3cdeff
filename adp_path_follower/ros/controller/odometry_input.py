"""The topic `odom`: what comes in is read, checked, and taken or rejected."""

from collections.abc import Callable
from dataclasses import replace

from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.safety.odometry_check import (
    Measurement,
    MissingTwist,
    OdometryCheck,
    OdometryProblem,
)
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.ros.runtime.conversions import measurement_of


class OdometryInput:
    """Keeps the last sound measurement."""

    def __init__(
        self,
        node: Node,
        settings: Callable[[], Settings],
        take: Callable[[Measurement], None],
        refuse: Callable[[OdometryProblem], None],
    ) -> None:
        """Subscribe; `take` gets sound measurements, `refuse` the fault of any other message."""
        self.measurement: Measurement | None = None
        self._node, self._settings = node, settings
        self._take, self._refuse = take, refuse
        self._check, self._missing_twist = OdometryCheck(), MissingTwist()
        self._subscription = node.create_subscription(
            Odometry, "odom", self._receive, qos_profile_sensor_data, raw=True
        )

    @property
    def pose(self) -> FloatArray | None:
        """Return the pose of the last measurement, None before the first."""
        return None if self.measurement is None else self.measurement.pose

    @property
    def speed(self) -> float:
        """Return the robot's speed [m/s], 0 before the first measurement."""
        return 0.0 if self.measurement is None else abs(float(self.measurement.twist[0]))

    def destroy(self) -> None:
        """End the subscription."""
        self._node.destroy_subscription(self._subscription)

    def _receive(self, raw: bytes) -> None:
        try:
            found = measurement_of(raw)
        except AdpError as error:
            self._refuse(OdometryProblem(str(error)))
            return
        told = self._missing_twist.missing
        found = replace(found, twist=self._missing_twist.twist(found, self._settings()))
        if self._missing_twist.missing and not told:
            self._node.get_logger().warning(
                "odometry has no velocity: its twist is zero while its pose moves, so velocities "
                "are taken from the poses; let its source fill in twist"
            )
        now = int(self._node.get_clock().now().nanoseconds)
        problem = self._check.problem(now, found, self._settings())
        if problem is not None:
            self._refuse(problem)
            return
        self.measurement = found
        self._take(found)
