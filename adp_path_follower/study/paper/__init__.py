"""Reproduces the paper's run and its figures.

May import `study.simulation`, `study.optimum` and all rooms below. Never changes the printed gains.
"""
