"""Compares this controller with its peers from the same starts.

May import `study.simulation`, `study.optimum` and all rooms below. Never tunes a controller.
"""
