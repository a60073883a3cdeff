"""The recorder node: its settings, choice of topics and provenance.

May import `ros.runtime`, `bags` and `messages`. Never interprets what it records.
"""
