"""A kinematic unicycle simulator and its node.

May import `adp_path_follower.core`, `messages` and `ros.runtime`.
Never knows a controller.
"""
