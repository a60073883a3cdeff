"""A sweep from its plan to its results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path as FilePath

from adp_path_follower import __version__
from adp_path_follower.core.files import output_to, write_output
from adp_path_follower.core.settings.parameter_file import parameter_file_text
from adp_path_follower.study.sweeps.overview import Overview, overview, shown
from adp_path_follower.study.sweeps.page import write_sweep_page
from adp_path_follower.study.sweeps.request.sweep_file import Sweep
from adp_path_follower.study.sweeps.workers.cluster import workers
from adp_path_follower.study.sweeps.workers.parts_folder import PartsFolder
from adp_path_follower.study.sweeps.workers.plan import Plan, work_off


def run_sweep(
    sweep: Sweep,
    directory: FilePath,
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


def write_results(found: Overview, title: str, directory: FilePath) -> None:
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
