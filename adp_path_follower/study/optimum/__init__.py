"""The offline optimum: the cost of a controller that knows everything in advance.

May import `core`, `drawing` and `study.simulation`; needs the extra `optimum` (CasADi).
Never drives a robot.
"""
