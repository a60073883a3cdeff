"""Drive MuJoCo robots by the real controller node over DDS in real time, and in one process.

    python bench/robots/real_time.py [--robots 4] [--first 0]

The plant is a node: it hears `cmd_vel` and publishes `odom`, late and stamped when it was measured.
Cost and distance should be those of the loop in one process, but for the network's delay.
"""

from __future__ import annotations

import argparse
import tempfile
import time as steady
from pathlib import Path as FilePath

import numpy as np
import rclpy
from drives import Outcome, drive
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry as OdometryMessage
from nav_msgs.msg import Path as PathMessage
from plants import Odometry
from random_robots import Case
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile

from adp_path_follower.core.control.value_store import value_grid
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.schema import flatten
from adp_path_follower.ros.runtime.conversions import odometry_message, poses_message
from adp_path_follower.study.demo import NodeProcess, own_domain

_DURATION = 20.0  # [s]
_PATIENCE = 60.0  # [s]
_SPACING = 0.02  # [m] of the path's poses


class PlantNode:
    """The plant's side of DDS: a control law that asks the network."""

    def __init__(self, domain: int, case: Case) -> None:
        """Publish the path; the robot stands until odometry is sent."""
        self._context = rclpy.Context()
        self._context.init(domain_id=domain)
        self._node = rclpy.create_node("mujoco_robot", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._odometry = self._node.create_publisher(OdometryMessage, "odom", 10)
        path = self._node.create_publisher(PathMessage, "path", latched)
        path.publish(poses_message(case.path.points(_SPACING), "odom", 0))
        self._node.create_subscription(TwistStamped, "cmd_vel", self._receive, 10)
        self._command: FloatArray = np.zeros(2)
        self._last: Odometry | None = None
        self._start, self._clock = 0.0, 0  # the plant's time 0: steady [s], and ROS's [ns]

    def _receive(self, message: TwistStamped) -> None:
        self._command = np.array([message.twist.linear.x, message.twist.angular.z])

    def wait_for(self, controller: NodeProcess) -> None:
        """Wait until the controller has the path and waits for odometry alone."""
        end = steady.monotonic() + _PATIENCE
        while "waiting: no odometry" not in controller.output():
            assert steady.monotonic() < end, controller.output()
            self._executor.spin_once(timeout_sec=0.1)

    def control(self, time: float, odometry: Odometry) -> FloatArray:
        """Return the command that has come by a time [s] of the plant, which is waited for."""
        if not self._clock:
            self._start = steady.monotonic() - time
            self._clock = self._node.get_clock().now().nanoseconds - round(1e9 * time)
        while (left := self._start + time - steady.monotonic()) > 0.0:
            self._executor.spin_once(timeout_sec=left)
        if odometry is not self._last:
            self._last = odometry
            stamp = self._clock + round(1e9 * odometry.stamp)
            message = odometry_message(stamp, odometry.pose, odometry.twist, ("odom", "base_link"))
            self._odometry.publish(message)
        return self._command

    def close(self) -> None:
        """Leave the network."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.shutdown()


def over_dds(case: Case) -> Outcome:
    """Return the outcome of the node in real time."""
    settings = case.settings(path_tolerance=0.0)  # nobody smooths the path in one process
    value_grid(settings)  # else a process looks for it beside the drive
    with own_domain() as domain, tempfile.TemporaryDirectory() as folder:
        log = FilePath(folder) / "controller.log"
        controller = NodeProcess("controller", flatten(settings), log=log, domain=domain)
        plant = PlantNode(domain, case)
        try:
            plant.wait_for(controller)
            return drive(case.plant(), plant.control, case.path, settings, _DURATION)
        finally:
            controller.stop()
            plant.close()


def main() -> None:
    """Print cost and distance both ways, and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    for seed in range(options.first, options.first + options.robots):
        case = Case(seed, "mujoco")
        loop, node = case.outcome("learned"), over_dds(case)
        print(
            f"{seed} {case.path_name} {case.speed:g} m/s: J {loop.cost:.4f} in a loop, "
            f"{node.cost:.4f} over DDS ({node.cost / loop.cost:.3f}); RMS {1e3 * loop.rms:.1f} mm, "
            f"{1e3 * node.rms:.1f} mm",
            flush=True,
        )


if __name__ == "__main__":
    main()
