"""Runs the trials of a sweep on workers, and keeps their results on disk.

May import `study.sweeps.request` and `study.simulation`. Never decides which trials to run.
"""
