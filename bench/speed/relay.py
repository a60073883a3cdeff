"""Run a bare node that answers every odometry message with a command: the cost of rclpy."""

import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data


def relay_with(node: Node) -> None:
    """Relay with a node until the process is ended."""
    publisher = node.create_publisher(TwistStamped, "cmd_vel", 10)

    def relay(message: Odometry) -> None:
        command = TwistStamped()
        command.header.stamp = message.header.stamp
        command.header.frame_id = message.child_frame_id
        command.twist.linear.x = message.pose.pose.position.x
        command.twist.angular.z = message.pose.pose.orientation.z
        publisher.publish(command)

    node.create_subscription(Odometry, "odom", relay, qos_profile_sensor_data)
    rclpy.spin(node)


if __name__ == "__main__":
    rclpy.init()
    relay_with(rclpy.create_node("relay"))
