"""Where the files lie that come with the package: parameter files and layouts."""

from __future__ import annotations

import os
import sys
from pathlib import Path as FilePath

from adp_path_follower.core.errors import FileError

PACKAGE = "adp_path_follower"


def config_file(name: str) -> FilePath:
    """Return a file of the package's config folder, such as "paper.yaml", wherever it is installed.

    Raises:
        FileError: There is no such file.

    """
    prefixes = [sys.prefix, *os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)]
    # With colcon, the prefix lies above .../lib/pythonX.Y/site-packages/adp_path_follower.
    prefixes += [str(parent) for parent in FilePath(__file__).resolve().parents[:6]]
    source = FilePath(__file__).resolve().parents[1] / "config" / name
    installed = [FilePath(prefix) / "share" / PACKAGE / "config" / name for prefix in prefixes]
    for file in (source, *installed):
        if file.is_file():
            return file
    raise FileError(f"file {name} did not come with this installation: install it again")
