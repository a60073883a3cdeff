"""The commands that read bags.

May import every room. Never imported by another.
"""
