"""Drives the demo: real nodes as processes on a DDS domain of their own.

May import `ros`, `bags` and all rooms below. Never measures the run: that is `analysis`.
"""
