"""`adp sweep`: many settings on many starts, paths and robots, on all cores or machines."""

from __future__ import annotations

import time
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import click

from adp_path_follower.cli.options import FILE, cluster_options, progress_bar, resumable
from adp_path_follower.extras import require

if TYPE_CHECKING:  # Dask and pyarrow are loaded when there is something to run
    from adp_path_follower.study.sweeps.request.request import Sweep


@click.command()
@click.argument("file", type=FILE, metavar="SWEEP.yaml")
@cluster_options
def sweep(
    file: FilePath,
    directory: FilePath | None,
    scheduler: str | None,
    workers: int | None,
    dry_run: bool,
) -> None:
    r"""Simulate many settings on many starts, paths and robots, on all cores.

    \b
    How long?           adp sweep --dry-run SWEEP.yaml
    Run it, or go on:   adp sweep config/sweeps/paper_gains.yaml --out gains
    On a Dask cluster:  adp sweep SWEEP.yaml --out DIR --scheduler tcp://host:8786

    `adp docs sweeps` explains SWEEP.yaml. Writes the runs as Parquet files, one after the other: an
    interrupted sweep goes on where it was when the same command is given again. At the end,
    report.html (heat maps and the Pareto front) and best.yaml (the best settings).
    """
    require("adp sweep", "sweep")
    from adp_path_follower.study.sweeps.request.files import read_sweep
    from adp_path_follower.study.sweeps.workers.plan import check_first_runs

    asked = read_sweep(file)
    check_first_runs(asked)
    if dry_run:
        _say_how_long(asked, scheduler, workers)
        return
    if directory is None:
        raise click.UsageError("give a folder for the results: --out DIR")
    _run(asked, file.stem, directory, scheduler, workers)


def _say_how_long(asked: Sweep, scheduler: str | None, workers: int | None) -> None:
    from adp_path_follower.study.sweeps.workers.plan import estimate, in_words

    conditions = asked.conditions
    click.echo(
        f"{asked.runs:,} runs of {conditions.run.duration:g} s: {asked.combinations:,} "
        f"combinations of settings × {len(conditions.paths)} paths × "
        f"{len(conditions.robots)} robots × {len(conditions.noise_seeds)} noise seeds × "
        f"{len(conditions.starts)} starts"
    )
    found = estimate(asked, scheduler, workers)
    click.echo(
        f"about {in_words(found.seconds)} on {found.workers} "
        f"{'workers of the scheduler' if scheduler else 'processes'}: a run takes "
        f"{found.seconds_each:.3f} s, measured here on a few of them"
    )


def _run(
    asked: Sweep, title: str, directory: FilePath, scheduler: str | None, workers: int | None
) -> None:
    from adp_path_follower.study.sweeps.overview import overview, summary_text
    from adp_path_follower.study.sweeps.page import write_results
    from adp_path_follower.study.sweeps.workers import cluster
    from adp_path_follower.study.sweeps.workers.parts_folder import PartsFolder
    from adp_path_follower.study.sweeps.workers.plan import Plan, in_words

    begun = time.monotonic()
    plan = Plan(asked)
    with PartsFolder(directory, plan) as folder:
        missing = folder.missing()
        fresh = sum(len(plan.runs_of(number)) for number in missing)
        if fresh < asked.runs:
            click.echo(f"{asked.runs - fresh:,} of {asked.runs:,} runs are there already", err=True)
        if missing:
            with (
                resumable(),
                cluster.workers(scheduler, workers) as found_workers,
                progress_bar(f"simulating {fresh:,} runs") as progress,
            ):
                folder.run(missing, found_workers, progress)
        found = overview(asked, folder.combinations())
    spent = time.monotonic() - begun
    click.echo(summary_text(found))
    write_results(found, title, directory)
    click.echo(
        f"\n{fresh:,} runs in {in_words(spent)}, {fresh / spent:.1f} a second. In {directory}: "
        f"report.html, runs/ (Parquet){', best.yaml' if found.best is not None else ''}"
    )
