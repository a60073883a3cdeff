"""Run the relay in a node with the services, subscriptions and events of the controller."""

import math

import rclpy
from nav_msgs.msg import Path
from rclpy.lifecycle import LifecycleNode
from relay import relay_with
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from adp_path_follower.ros.controller.commands import Watchdog

_SERVICES = ("reset_learning", "stop", "resume", "save_weights")

if __name__ == "__main__":
    rclpy.init()
    node = LifecycleNode("relay")
    node.create_subscription(Path, "path", lambda message: None, 1, raw=True)
    node.create_subscription(Float64, "speed_limit", lambda message: None, 1)
    node.create_guard_condition(lambda: None)
    for name in _SERVICES:
        node.create_service(Trigger, f"~/{name}", lambda request, response: response)
    watchdog = Watchdog(node, lambda: math.inf)  # as calm as while the controller follows
    relay_with(node)
