"""Optional libraries: imported at first use, and named in one sentence where they are missing."""

import importlib
import importlib.util
from types import ModuleType
from typing import Any

from adp_path_follower.core.errors import AdpError

# Extra of setup.py -> the modules that it installs.
EXTRAS = {
    "jazzy": ("rclpy",),
    "optimum": ("casadi",),
    "report": ("plotly", "jinja2"),
    "sweep": ("distributed", "optuna", "pyarrow", "plotly", "jinja2"),
}
_TITLES = {"casadi": "CasADi", "plotly": "Plotly", "jinja2": "Jinja2", "rclpy": "ROS 2"}
_HINTS = {"pyarrow": "with numpy 1, pip install 'pyarrow<26'"}
_SLOW = ("distributed", "optuna")  # to import: half a second each, which not every command needs


def is_installed(extra: str) -> bool:
    """Return whether all libraries of an extra, one of `EXTRAS`, are installed."""
    return all(importlib.util.find_spec(name) is not None for name in EXTRAS[extra])


def require(subject: str, extra: str) -> None:
    """Check that the libraries of an extra, one of `EXTRAS`, are installed for a subject.

    Raises AdpError, which names "adp sweep" or another subject and says how to install them.
    """
    missing = [name for name in EXTRAS[extra] if importlib.util.find_spec(name) is None]
    if missing:
        raise AdpError(missing_text(subject, extra, *missing))
    for name in EXTRAS[extra]:
        if name not in _SLOW:
            _imported(name, subject, extra)


def missing_text(subject: str, extra: str, *modules: str) -> str:
    """Return the sentence that names missing modules and how to install them."""
    names = ", ".join(_TITLES.get(name, name) for name in modules)
    first = "source a ROS 2 Jazzy installation, or " if extra == "jazzy" else ""
    return f"{subject} needs {names}: {first}pip install 'adp_path_follower[{extra}]'"


def _imported(name: str, subject: str, extra: str) -> ModuleType:
    """Return a module; raise AdpError if it is missing, or does not work here."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        if name in _HINTS:
            raise AdpError(f"{subject} needs another {name} ({error}): {_HINTS[name]}") from None
        raise AdpError(missing_text(subject, extra, name)) from None


class Library:
    """An optional module that is imported when something of it is first used.

    Raises `AdpError`, as `require` does, at that use. For example:

        casadi = Library("casadi", "the offline optimum", "optimum")
        casadi.MX.sym("x")
    """

    def __init__(self, name: str, subject: str, extra: str) -> None:
        self._name, self._subject, self._extra = name, subject, extra

    def __getattr__(self, attribute: str) -> Any:
        """Return something of the module."""
        return getattr(_imported(self._name, self._subject, self._extra), attribute)
