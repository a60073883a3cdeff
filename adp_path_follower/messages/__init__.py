"""The wire format of ROS messages and the configuration text, without ROS.

May import `core`.
Never imports rclpy.
"""
