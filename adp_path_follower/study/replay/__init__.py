"""Replays recorded runs: bit by bit, with other settings, or in closed loop.

May import `bags`, `study.simulation`, `ros.runtime` and all rooms below.
Never changes the recorded bag.
"""
