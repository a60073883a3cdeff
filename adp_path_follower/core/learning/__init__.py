"""Critic and actor: Bellman errors at samples, update laws, weights.

May import `core.control` and all rooms below it.
Never sends a command.
"""
