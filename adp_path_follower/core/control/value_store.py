"""Value functions on grids, found once for all processes of a user.

One takes some ten seconds to find, so it is kept in a file: in $XDG_CACHE_HOME/adp_path_follower,
~/.cache/adp_path_follower, or the temporary directory where there is no home. The file's name is a
digest of the problem and of how it is solved.
"""

import contextlib
import dataclasses
import functools
import hashlib
import io
import logging
import math
import os
import tempfile
import zipfile
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower.core.control.value_grid import GridAxes, ValueGrid
from adp_path_follower.core.control.value_iteration import METHOD, ValueProblem, solve
from adp_path_follower.core.files import write_whole
from adp_path_follower.core.settings.groups import Settings

_LOG = logging.getLogger(__name__)
_MOST_FILES = 40  # of 2 MB each; the oldest ones go


def problem_of(settings: Settings) -> ValueProblem:
    """Return what the value function depends on: not phi, nor a speed limit for now."""
    target = dataclasses.replace(settings.target, path_state_gain=1.0)
    limits = dataclasses.replace(settings.limits, speed_limit=math.inf)
    return ValueProblem(target, settings.cost, limits)


def value_grid(settings: Settings) -> ValueGrid:
    """Return the value function of settings; where it is not stored yet, find and store it."""
    problem = problem_of(settings)
    found = stored(problem)
    if found is None:
        _LOG.info(
            "finding the value function far from the path: ten seconds, once for these settings"
        )
        store(problem)
        found = stored(problem)
    return _solved(problem) if found is None else found


_found: dict[ValueProblem, ValueGrid] = {}


def stored(problem: ValueProblem) -> ValueGrid | None:
    """Return a value function that was found before, None if it was not."""
    if problem not in _found:
        with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            with np.load(_file(problem), allow_pickle=False) as content:
                shape = tuple(int(n) for n in content["shape"])
                axes = GridAxes((shape[0], shape[1], shape[2]), float(content["reach"]))
                arrays = [content[key] for key in ("curvatures", "riccati", "coefficients")]
            _found[problem] = ValueGrid(axes, *arrays)
    return _found.get(problem)


def store(problem: ValueProblem) -> None:
    """Find a value function and store it; where no file can be written, keep it in memory."""
    grid = _solved(problem)
    content = io.BytesIO()
    np.savez(
        content,
        shape=grid.axes.shape,
        reach=grid.axes.reach,
        curvatures=grid.curvatures,
        riccati=grid.riccati,
        coefficients=grid.coefficients,
    )
    with contextlib.suppress(OSError):
        file = _file(problem)
        file.parent.mkdir(parents=True, exist_ok=True)
        others = sorted(file.parent.glob("value_*.npz"), key=lambda other: other.stat().st_mtime)
        for other in others[: -(_MOST_FILES - 1)]:
            other.unlink(missing_ok=True)
        write_whole(file, content.getvalue(), file.with_suffix(f".{os.getpid()}.unfinished"))


@functools.lru_cache(4)
def _solved(problem: ValueProblem) -> ValueGrid:
    return solve(problem)


def _file(problem: ValueProblem) -> FilePath:
    digest = hashlib.sha256(repr((problem, METHOD)).encode()).hexdigest()[:24]
    return _directory() / f"value_{digest}.npz"


def _directory() -> FilePath:
    base = os.environ.get("XDG_CACHE_HOME")
    if base:
        return FilePath(base) / "adp_path_follower"
    try:
        return FilePath.home() / ".cache" / "adp_path_follower"
    except RuntimeError:
        return FilePath(tempfile.gettempdir()) / "adp_path_follower"
