"""Recovers bags that were cut off or damaged.

May import `bags`, `messages` and `core`.
Never changes the damaged bag.
"""
