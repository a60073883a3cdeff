"""The offline optimum: what a controller that knows everything in advance would cost.

Needs the extra `optimum` (CasADi with IPOPT).
"""
