"""A robot from a bag: which model answers its commands as it did.

May import `bags`, `core` and the rest of `analysis`. Never draws.
"""
