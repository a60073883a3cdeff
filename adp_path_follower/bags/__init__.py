"""Writes and reads bags.

May import `messages` and `core`.
Never imports rclpy.
"""
