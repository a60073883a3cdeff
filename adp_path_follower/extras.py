"""The libraries that only sweeps and tuning need."""

from __future__ import annotations

import importlib.util

from adp_path_follower.core.errors import AdpError

_PACKAGES = ("distributed", "optuna", "pyarrow", "plotly", "jinja2")


def require_extra(command: str) -> None:
    """Refuse a command whose libraries are not installed.

    Raises:
        AdpError: One is missing; the message says how to install it.

    """
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    if missing:
        raise AdpError(
            f"{command} needs {', '.join(missing)}: pip install 'adp_path_follower[sweep]'"
        )
    try:
        import pyarrow  # noqa: F401  # only whether it can be: it asks for a numpy of its time
    except ImportError as error:
        raise AdpError(
            f"{command} needs another pyarrow ({error}): with numpy 1, pip install 'pyarrow<26'"
        ) from None
