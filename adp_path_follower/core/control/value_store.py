"""Value functions on grids, found once for all processes of a user.

One takes some five seconds to find, so it is kept in a file: in $XDG_CACHE_HOME/adp_path_follower,
~/.cache/adp_path_follower, or the temporary directory where there is no home. The file's name is a
digest of the problem and of how it is solved.
"""

import contextlib
import dataclasses
import hashlib
import io
import logging
import math
import os
import pickle
import sys
import tempfile
import threading
import zipfile
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower.core.control.value_grid import DistantValue, GridAxes, PolarAxes, ValueGrid
from adp_path_follower.core.control.value_iteration import METHOD, ValueProblem, solve
from adp_path_follower.core.files import write_whole
from adp_path_follower.core.settings.groups import Settings

_LOG = logging.getLogger(__name__)
_MOST_FILES = 40  # of 2 MB each; the oldest ones go
_MOST_KEPT = 6  # in memory
_NICE = 10  # control comes first, with ten times the processor's share


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
            "finding the value function far from the path: five seconds, once for these settings"
        )
        keep(problem, store(problem))
    return _found[problem]


_found: dict[ValueProblem, ValueGrid] = {}


def stored(problem: ValueProblem) -> ValueGrid | None:
    """Return a value function that was found before, None if it was not."""
    if problem not in _found:
        with contextlib.suppress(OSError):
            keep(problem, _file(problem).read_bytes())
            _file(problem).touch()  # the one that was not used for longest goes first
    return _found.get(problem)


def keep(problem: ValueProblem, content: bytes) -> None:
    """Keep the value function that a file has, if it is sound, as one of the last few."""
    with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            shape, lengths = tuple(arrays["shape"].tolist()), arrays["lengths"].tolist()
            near, far = GridAxes(shape[:3], *lengths[:2]), PolarAxes(shape[3:], *lengths[2:])
            kappa, coefficients = arrays["curvatures"], arrays["coefficients"]
            distant = DistantValue(far, kappa[: len(arrays["distant"])], arrays["distant"])
            grid = ValueGrid(near, kappa, arrays["riccati"], coefficients, distant)
        if len(_found) >= _MOST_KEPT:
            _found.pop(next(iter(_found)))
        _found[problem] = grid


def store(problem: ValueProblem) -> bytes:
    """Find a value function, write its file, if that is possible, and return what is in it."""
    grid = solve(problem)
    content = io.BytesIO()
    near, far = grid.axes, grid.distant.axes
    np.savez(
        content,
        shape=(*near.shape, *far.shape),
        lengths=(near.reach, near.bend, far.start, far.end),
        curvatures=grid.curvatures,
        riccati=grid.riccati,
        coefficients=grid.coefficients,
        distant=grid.distant.coefficients,
    )
    with contextlib.suppress(OSError):
        file = _file(problem)
        file.parent.mkdir(parents=True, exist_ok=True)
        others = sorted(file.parent.glob("value_*.npz"), key=lambda other: other.stat().st_mtime)
        for other in others[: -(_MOST_FILES - 1)]:
            other.unlink(missing_ok=True)
        write_whole(file, content.getvalue())
    return content.getvalue()


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


def main() -> None:
    """Find the values of the pickled problem that comes in, and write them out, for a node."""
    os.nice(_NICE)
    problem = pickle.load(sys.stdin.buffer)  # noqa: S301  # written by the node
    threading.Thread(target=_end_with_node, daemon=True).start()
    sys.stdout.buffer.write(store(problem))


def _end_with_node() -> None:
    os.read(sys.stdin.fileno(), 1)  # the node writes no more, and its end ends this
    os._exit(1)


if __name__ == "__main__":  # python -m adp_path_follower.core.control.value_store
    main()
