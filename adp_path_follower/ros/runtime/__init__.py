"""The ground of all nodes: executor, parameters, frames, logs, shutdown.

May import `messages` and `core`. Never knows what a node is for.
"""
