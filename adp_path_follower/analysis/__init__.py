"""A recorded run: its numbers, its events and its page.

May import `study`, `drawing`, `bags`, `messages` and `core`. Never imports rclpy.
"""
