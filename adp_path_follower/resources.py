"""Finds the files that come with the package: parameter files, layouts and docs pages."""

import difflib
import os
import sys
from pathlib import Path as FilePath

from adp_path_follower.core.errors import FileError

PACKAGE = "adp_path_follower"
FORTY_STARTS = FilePath(__file__).parent / "data" / "forty_starts.csv"


def config_file(name: str) -> FilePath:
    """Return a file of the config folder, such as "paper.yaml"; FileError if it is missing."""
    return _shared(f"config/{name}")


def parameter_file(name: str) -> FilePath:
    """Return a packaged file such as "paper", or the file named ("./paper"); else FileError."""
    file = FilePath(name)
    if file.suffix or os.sep in name or name in ("", os.curdir, os.pardir):
        return file
    known = sorted(item.stem for item in config_file("default.yaml").parent.glob("*.yaml"))
    if name in known:
        return config_file(f"{name}.yaml")
    if file.exists():
        return file
    raise FileError(f"unknown parameters '{name}'{did_you_mean(name, known)}, or give a file")


def shipped_file(folder: str, name: str, kind: str) -> FilePath:
    """Return a file, or the one of a name in a folder of config; FileError if it is neither."""
    file = FilePath(name)
    if file.suffix or file.exists():
        return file
    known = {item.stem: item for item in (config_file("default.yaml").parent / folder).iterdir()}
    if name not in known:
        raise FileError(f"{kind} '{name}' is neither a file nor one of {', '.join(sorted(known))}")
    return known[name]


def docs_page(name: str) -> FilePath:
    """Return a page of the docs, such as "sweeps"; raise FileError if it is missing."""
    known = docs_pages()
    if name not in known:
        raise FileError(f"unknown page '{name}'{did_you_mean(name, known)}")
    return _shared(f"docs/{name}.md")


def docs_pages() -> list[str]:
    """Return the names of the docs pages."""
    return sorted(file.stem for file in _shared("docs/parameters.md").parent.glob("*.md"))


def did_you_mean(name: str, known: list[str]) -> str:
    """Return the end of a sentence that rejects a name: the nearest known one, and all of them."""
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean '{near[0]}'?" if near else ":"
    return f"{hint} available: {', '.join(known)}"


def _shared(name: str) -> FilePath:
    """Return a file beside the package's source, or of an installation's share folder."""
    package = FilePath(__file__).resolve().parent
    prefixes = [sys.prefix, *os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)]
    # With colcon, the prefix lies above .../lib/pythonX.Y/site-packages/adp_path_follower.
    prefixes += [str(parent) for parent in [package, *package.parents[:5]]]
    installed = [FilePath(prefix) / "share" / PACKAGE / name for prefix in prefixes]
    for file in (package.parent / name, *installed):
        if file.is_file():
            return file
    raise FileError(f"file {name} did not come with this installation: install it again")
