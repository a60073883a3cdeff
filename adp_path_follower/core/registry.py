"""Parts of a user's own under names: value bases, policies far from the path, peers.

Plugins are the modules that register such parts. `ADP_PLUGINS` names them, as modules or as .py
files with commas between; they are imported when a name is asked for that nobody knows yet.
"""

import importlib
import importlib.util
import os
import re
import sys
from pathlib import Path as FilePath
from typing import Generic, TypeVar

from adp_path_follower.core.errors import AdpError

Part = TypeVar("Part")

PLUGINS = "ADP_PLUGINS"  # name of the environment variable

_loaded: set[str] = set()


class Registry(Generic[Part]):
    """The parts of one kind, by name."""

    def __init__(self, kind: str, built_in: tuple[str, ...]) -> None:
        """Begin empty, for a kind such as "basis" whose built-in names cannot be registered."""
        self._kind, self._built_in = kind, built_in
        self._parts: dict[str, Part] = {}

    def register(self, name: str, part: Part) -> None:
        """Keep a part under a name, in place of an earlier one; AdpError for an invalid name."""
        if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*", name):
            raise AdpError(
                f"{self._kind} has the name {name!r}, but must have letters, digits and _ only"
            )
        if name in self._built_in:
            raise AdpError(f"{self._kind} '{name}' comes with the package: choose another name")
        self._parts[name] = part

    def find(self, name: str) -> Part | None:
        """Return the part of a name, None if no plugin knows it; AdpError if a plugin fails."""
        if name not in self._parts:
            load_plugins()
        return self._parts.get(name)

    def parts(self) -> dict[str, Part]:
        """Return name -> part of those registered so far."""
        return dict(self._parts)


def load_plugins() -> None:
    """Import the modules of `ADP_PLUGINS`, each once; AdpError if one is missing or wrong."""
    for plugin in map(str.strip, os.environ.get(PLUGINS, "").split(",")):
        if plugin and plugin not in _loaded:
            _loaded.add(plugin)
            try:
                _import(plugin)
            except Exception as error:  # whatever a user's module raises
                _loaded.discard(plugin)
                reason = (
                    error if isinstance(error, AdpError) else f"{type(error).__name__}: {error}"
                )
                raise AdpError(f"plugin '{plugin}' of {PLUGINS}: {reason}") from None


def _import(plugin: str) -> None:
    if not plugin.endswith(".py"):
        importlib.import_module(plugin)
        return
    file = FilePath(plugin).expanduser()
    if not file.is_file():
        raise AdpError("there is no such file")
    if file.stem in sys.modules:
        raise AdpError(f"a module '{file.stem}' is there already: rename the file")
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[file.stem] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[file.stem]
        raise
