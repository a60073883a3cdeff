"""The offline optimum: what a controller that knows everything in advance would cost.

Needs the extra `optimum` (CasADi with IPOPT).
"""

from adp_path_follower.core.errors import AdpError

try:
    import casadi as _casadi  # noqa: F401  # only whether it is there
except ImportError:
    raise AdpError(
        "the offline optimum needs CasADi: pip install 'adp_path_follower[optimum]'"
    ) from None
