"""A sweep from its plan to its results."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from adp_path_follower import __version__
from adp_path_follower.core.files import output_to, write_output
from adp_path_follower.core.settings.parameter_file import parameter_file_text
from adp_path_follower.sweeping.cluster import workers
from adp_path_follower.sweeping.estimate import batch_time
from adp_path_follower.sweeping.overview import Overview, overview, shown
from adp_path_follower.sweeping.parts_folder import PartsFolder
from adp_path_follower.sweeping.plan import Plan, work_off
from adp_path_follower.sweeping.sweep_file import Sweep
from adp_path_follower.sweeping.sweep_page import write_sweep_page

_TIMED_PARTS = 3


@dataclass(frozen=True)
class Estimate:
    """How long a sweep will take.

    Attributes:
        workers: How many parts are worked off at once.
        seconds: Of computing time on all of them [s].
        seconds_each: Of a run, on one [s].

    """

    workers: int
    seconds: float
    seconds_each: float


def estimate(sweep: Sweep, address: str | None, count: int | None) -> Estimate:
    """Return how long a sweep will take, by a few of its batches on this machine.

    Raises:
        AdpError: The scheduler cannot be reached.

    """
    plan = Plan(sweep)
    numbers = np.unique(np.linspace(0, plan.parts - 1, _TIMED_PARTS).astype(int))
    batches = [plan.part(int(number)).batches[0] for number in numbers]
    each = batch_time(batches) / float(np.mean([len(batch) for batch in batches]))
    with workers(address, count) as found:
        at_once = found.count
    return Estimate(at_once, each * sweep.runs / min(at_once, plan.parts), each)


def run_sweep(
    sweep: Sweep,
    directory: Path,
    address: str | None,
    count: int | None,
    begin: Callable[[int, int], Callable[[float], None]],
) -> Overview:
    """Do the runs that are not there yet, and return what all of them say.

    Args:
        sweep: What to run.
        directory: Where the results go, and those of an interrupted sweep are.
        address: Of a Dask scheduler; None for the cores of this machine.
        count: Number of processes on this machine; None for all cores.
        begin: Called with the number of runs and of those that are there already; returns what
            takes the fraction of the rest that is done.

    Raises:
        AdpError: Folder, scheduler or workers fail; what is done stays.

    """
    plan = Plan(sweep)
    with PartsFolder(directory, plan) as folder:
        missing = folder.missing()
        open_runs = sum(len(plan.runs_of(number)) for number in missing)
        there = sweep.runs - open_runs
        if not missing:
            begin(sweep.runs, there)(1.0)
            return overview(sweep, folder.combinations())
        with workers(address, count) as found:
            progress = begin(sweep.runs, there)
            parts = (plan.part(number) for number in missing)
            for done, (part, columns) in enumerate(found.results(work_off, parts), start=1):
                folder.add(part.number, columns)
                progress(done / len(missing))
        return overview(sweep, folder.combinations())


def write_results(found: Overview, title: str, directory: Path) -> None:
    """Write the page, and the best settings as a parameter file.

    Raises:
        FileError: One of them cannot be written.

    """
    write_sweep_page(found, title, directory / "report.html")
    best = directory / "best.yaml"
    if found.best is None:
        with output_to(best):
            best.unlink(missing_ok=True)
        return
    scores = ", ".join(
        f"{name} {found.scores[name][found.best]:.5g}" for name in found.sweep.objectives
    )
    values = ", ".join(f"{name}: {shown(item)}" for name, item in found.values(found.best).items())
    write_output(
        best,
        f"# The best settings of {title} ({scores}), found by adp sweep {__version__}.\n"
        f"# Of what was varied: {values or 'nothing'}.\n"
        + parameter_file_text(found.sweep.settings(found.best), "path_follower"),
    )
