"""Arc-length paths: from points, preparation, smoothing, speed along them, reversing.

May import `core.settings` and the ground of `core`.
Never knows a controller.
"""
