"""Drives one robot: the command law, the follower, arrival, changes on the way.

May import every other room of `core`.
Never knows messages, bags or nodes.
"""
