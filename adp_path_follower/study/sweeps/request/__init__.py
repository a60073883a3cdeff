"""The request of a sweep or a tuning: file format, ranges, conditions.

May import `core`, `study.simulation` and rooms below. Never runs anything.
"""
