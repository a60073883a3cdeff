"""`adp sweep`: many settings on many starts, paths and robots, on all cores or machines."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import click

from adp_path_follower.cli.options import FILE, cluster_options, progress_bar
from adp_path_follower.extras import require

if TYPE_CHECKING:  # Dask and pyarrow are wanted when there is something to run
    from adp_path_follower.study.sweeps.request.sweep_file import Sweep


@click.command()
@click.argument("file", type=FILE, metavar="SWEEP.yaml")
@click.option(
    "--out",
    "directory",
    type=FILE,
    metavar="DIR",
    help="Where the results go: a new directory, or that of the same sweep, which then goes on.",
)
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
    from adp_path_follower.study.sweeps.request.sweep_file import read_sweep
    from adp_path_follower.study.sweeps.workers.plan import check_first_runs

    asked = read_sweep(file)
    check_first_runs(asked)
    if dry_run:
        _say_how_long(asked, scheduler, workers)
        return
    if directory is None:
        raise click.UsageError("say where the results go: --out DIR")
    _run(asked, file.stem, directory, scheduler, workers)


def _say_how_long(asked: Sweep, scheduler: str | None, workers: int | None) -> None:
    from adp_path_follower.study.sweeps.workers.estimate import estimate, in_words

    conditions = asked.conditions
    click.echo(
        f"{asked.runs:,} runs of {conditions.duration:g} s: {asked.combinations:,} combinations of "
        f"settings × {len(conditions.paths)} paths × {len(conditions.robots)} robots × "
        f"{len(conditions.noise_seeds)} noise seeds × {len(conditions.starts)} starts"
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
    from adp_path_follower.study.sweeps.overview import summary_text
    from adp_path_follower.study.sweeps.sweep import run_sweep, write_results
    from adp_path_follower.study.sweeps.workers.estimate import in_words

    begun = time.monotonic()
    fresh = 0
    with contextlib.ExitStack() as stack:

        def begin(runs: int, there: int) -> Callable[[float], None]:
            nonlocal fresh
            fresh = runs - there
            if there:
                click.echo(f"{there:,} of {runs:,} runs are there already", err=True)
            return stack.enter_context(progress_bar(f"simulating {fresh:,} runs"))

        try:
            found = run_sweep(asked, directory, scheduler, workers, begin)
        except KeyboardInterrupt:
            click.echo("\nadp: what is done stays: the same command goes on from it", err=True)
            raise
    spent = time.monotonic() - begun
    click.echo(summary_text(found))
    write_results(found, title, directory)
    click.echo(
        f"\n{fresh:,} runs in {in_words(spent)}, {fresh / spent:.1f} a second. In {directory}: "
        f"report.html, runs/ (Parquet){', best.yaml' if found.best is not None else ''}"
    )
