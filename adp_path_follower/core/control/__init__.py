"""From error to command: dynamics, cost, limits, Riccati and far policies.

May import `core.path`, `core.settings` and the ground of `core`.
Never learns.
"""
