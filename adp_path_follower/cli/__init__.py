"""The `adp` command: options, outputs and exit codes.

May import every room. Never does mathematics.
"""
