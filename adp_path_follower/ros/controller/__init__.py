"""The controller node: its inputs, outputs, watchdog and path process.

May import `ros.runtime` and all rooms below `ros`. Never does mathematics.
"""
