"""Runs a sweep, and writes its results."""

from collections.abc import Callable
from pathlib import Path as FilePath

from adp_path_follower import __version__
from adp_path_follower.core.files import output_to
from adp_path_follower.study.sweeps.overview import Overview, write_settings
from adp_path_follower.study.sweeps.page import write_sweep_page
from adp_path_follower.study.sweeps.workers.cluster import Workers
from adp_path_follower.study.sweeps.workers.parts_folder import PartsFolder
from adp_path_follower.study.sweeps.workers.plan import work_off


def run_missing(
    folder: PartsFolder, missing: list[int], workers: Workers, progress: Callable[[float], None]
) -> None:
    """Run the missing parts of a sweep, and write each one into the folder.

    `progress` is called with the fraction done. Raises AdpError if folder or workers fail; finished
    parts stay.
    """
    parts = (folder.plan.part(number) for number in missing)
    for done, (part, columns) in enumerate(workers.results(work_off, parts), start=1):
        folder.add(part.number, columns)
        progress(done / len(missing))


def write_results(found: Overview, title: str, directory: FilePath) -> None:
    """Write the page, and the best settings as a parameter file; may raise FileError."""
    write_sweep_page(found, title, directory / "report.html")
    best = directory / "best.yaml"
    if found.best is None:
        with output_to(best):
            best.unlink(missing_ok=True)
        return
    scores = ", ".join(
        f"{name} {found.scores[name][found.best]:.5g}" for name in found.sweep.objectives
    )
    comment = f"The best settings of {title} ({scores}), found by adp sweep {__version__}."
    settings, values = found.sweep.settings(found.best), found.sweep.varied(found.best)
    write_settings(best, settings, comment, values)
