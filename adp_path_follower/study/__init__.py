"""Experiments that show what the controller is worth, offline or live.

May import every room below it, the simulated robot included.
Never is imported by nodes, and never imports `analysis` or `cli`.
"""
