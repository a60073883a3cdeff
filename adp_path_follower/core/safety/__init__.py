"""Checks odometry and decides whether the robot may drive.

May import `core.settings` and the ground of `core`.
Never computes a command other than a stop.
"""
