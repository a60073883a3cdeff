"""The robot that is driven: its model, its state, what driving tells of it, and commands for it.

May import `core.settings`, `core.control` and the ground of core.
Never knows paths, learning or ROS.
"""
