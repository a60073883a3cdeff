"""Share what is expensive to make between the workers of a test run."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path as FilePath

import pytest


def made_once(
    name: str, factory: pytest.TempPathFactory, make: Callable[[FilePath], object]
) -> FilePath:
    """Return a folder of the run's that one worker makes, while the others wait.

    Args:
        name: Name of the folder.
        factory: The factory of a worker's temporary folders.
        make: Fills the new folder; what it raises is for its own worker, and the next one tries.

    """
    own = factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / name
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = folder.with_suffix(".done")
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            make(folder)
            done.touch()
    return folder
