"""The offline optimum: the cost of a controller that knows everything in advance.

May import `core`, `drawing` and `study.simulation`; needs the extra `optimum` (CasADi).
Never drives a robot.
"""

from adp_path_follower.core.errors import AdpError

try:
    import casadi as _casadi  # noqa: F401  # only whether it is there
except ImportError:
    raise AdpError(
        "the offline optimum needs CasADi: pip install 'adp_path_follower[optimum]'"
    ) from None
