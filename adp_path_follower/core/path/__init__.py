"""Arc-length paths: from points, preparation, smoothing, speed along them.

May import `core.settings` and the ground of `core`.
Never knows a controller.
"""
