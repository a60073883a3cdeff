"""`adp sweep` and `adp tune`: many settings on many starts, paths and robots, on all cores."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import click

from adp_path_follower.cli import options
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.extras import require

if TYPE_CHECKING:  # Dask and Optuna are loaded when there is something to run
    from adp_path_follower.study.sweeps.cluster import Workers
    from adp_path_follower.study.sweeps.conditions import Conditions
    from adp_path_follower.study.sweeps.request import Tuning
    from adp_path_follower.study.sweeps.results import Results

_TIMED = 3  # combinations of a sweep that are timed for --dry-run


@click.command()
@click.argument("file", type=options.FILE, metavar="SWEEP.yaml")
@options.cluster_options
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
    from adp_path_follower.study.sweeps.folder import PartsFolder
    from adp_path_follower.study.sweeps.request import read_sweep
    from adp_path_follower.study.sweeps.results import results
    from adp_path_follower.study.sweeps.runs import check_paths
    from adp_path_follower.study.sweeps.study import sweep_study

    asked = read_sweep(file)
    count = asked.combinations
    check_paths(asked.conditions, asked.settings(0))
    if dry_run:
        some = [asked.settings(number) for number in range(0, count, -(-count // _TIMED))]
        _say_how_long(asked.conditions, some, count, asked.parts, scheduler, workers)
        return
    begun = time.monotonic()
    with PartsFolder(_needed(directory), asked) as folder:
        missing = folder.missing()
        fresh = sum(len(asked.runs_of(part)) for part in missing)
        if fresh < asked.runs:
            click.echo(f"{asked.runs - fresh:,} of {asked.runs:,} runs are there already", err=True)
        if missing:
            with _at_work(f"simulating {fresh:,} runs", scheduler, workers) as (found, progress):
                folder.run(missing, found, progress)
        _tell(results(sweep_study(asked, folder.scores()), asked), file.stem, folder.directory)
    spent = time.monotonic() - begun
    click.echo(f"{fresh:,} runs in {_in_words(spent)}, {fresh / spent:.1f} a second")


@click.command()
@click.argument("file", type=options.FILE, metavar="[TUNE.yaml]", required=False)
@options.settings_options
@click.option(
    "--vary",
    multiple=True,
    metavar="NAME[=RANGE]",
    help="Without TUNE.yaml: a setting to tune, over its own range or as in "
    "--vary 'actor_gain={low: 1.0, high: 50.0, log: true}'; the learner's rates and samples if "
    "none is given.",
)
@click.option(
    "--objective",
    "objectives",
    multiple=True,
    metavar="NAME",
    help="Without TUNE.yaml: what is to be small, cost if not given; several for a Pareto front.",
)
@click.option("--trials", type=click.IntRange(1), metavar="N", help="Number of settings to try.")
@click.option(
    "--storage",
    metavar="URL",
    help="Database of the trials, as in postgresql://user@host/name; machines with the same "
    "storage tune together. A file in DIR if not given.",
)
@options.cluster_options
def tune(
    file: FilePath | None,
    params: FilePath | None,
    assignments: tuple[str, ...],
    vary: tuple[str, ...],
    objectives: tuple[str, ...],
    trials: int | None,
    directory: FilePath | None,
    storage: str | None,
    scheduler: str | None,
    workers: int | None,
    dry_run: bool,
) -> None:
    r"""Search for better settings by simulation, on all cores.

    \b
    The paper's laws:     adp tune config/sweeps/tune_paper.yaml --out tuned
    Without a file:       adp tune --params config/paper.yaml --out tuned
    One setting of mine:  adp tune --params my.yaml --vary actor_gain --out DIR
    How long it takes:    adp tune TUNE.yaml --dry-run

    `adp docs sweeps` explains TUNE.yaml. Settings that the validation rejects, or that are unstable
    in any run, are never proposed. Prints what was found and which settings matter, and writes
    best.yaml, which the node loads. An interrupted search goes on with the same command.
    """
    require("adp tune", "sweep")
    from adp_path_follower.study.sweeps.request import read_tuning, tuning_of_options

    if file is None:
        asked = tuning_of_options(params, assignments, vary, objectives)
    elif params is not None or assignments or vary or objectives:
        raise click.UsageError(
            "--params, --set, --vary and --objective are for a search without TUNE.yaml: put "
            "them into the file"
        )
    else:
        asked = read_tuning(file)
    if trials is not None:
        search = dataclasses.replace(asked.search, trials=trials)
        asked = dataclasses.replace(asked, search=search)
    title = str(file or params or "the default settings")
    if dry_run:
        count, at_once = asked.search.trials, asked.search.at_once
        before = [asked.conditions.settings]
        _say_how_long(asked.conditions, before, count, at_once, scheduler, workers)
        return
    _search(asked, title, _needed(directory), storage, scheduler, workers)


def _search(
    asked: Tuning,
    title: str,
    directory: FilePath,
    storage: str | None,
    scheduler: str | None,
    workers: int | None,
) -> None:
    """Try what is left of a search, and tell and write what was found."""
    from adp_path_follower.study.sweeps.folder import OutputFolder
    from adp_path_follower.study.sweeps.results import results
    from adp_path_follower.study.sweeps.study import open_study, tried
    from adp_path_follower.study.sweeps.study import tune as run_tuning

    begun, trials = time.monotonic(), asked.search.trials
    with OutputFolder(directory, "tune", asked.description()):
        place = storage or f"sqlite:///{(directory / 'study.db').absolute()}"
        study = open_study(asked, place, shared=storage is not None)
        there = len(tried(study))
        if there:
            click.echo(f"{there:,} of {trials:,} trials are there already", err=True)
        if there < trials:
            with _at_work(f"trying {trials:,} settings", scheduler, workers) as (found, progress):
                run_tuning(study, asked, found, progress)
        _tell(results(study, asked), title, directory)
        fresh = len(tried(study)) - there
    click.echo(f"{fresh:,} trials in {_in_words(time.monotonic() - begun)}")


def _needed(directory: FilePath | None) -> FilePath:
    """Return the folder of --out; raise UsageError if it is not given."""
    if directory is None:
        raise click.UsageError("give a folder for the results: --out DIR")
    return directory


def _say_how_long(
    conditions: Conditions,
    some: Sequence[Settings],
    count: int,
    at_once: int,
    scheduler: str | None,
    workers: int | None,
) -> None:
    """Say how many runs there are and how long they take, measured with some of the settings.

    `count` is the number of combinations of settings, `at_once` how many workers they can use.
    """
    from adp_path_follower.study.sweeps import cluster
    from adp_path_follower.study.sweeps.runs import seconds_each

    runs = count * conditions.runs
    click.echo(
        f"{runs:,} runs of {conditions.run.duration:g} s: {count:,} combinations of settings × "
        f"{len(conditions.paths)} paths × {len(conditions.robots)} robots × "
        f"{len(conditions.noise_seeds)} noise seeds × {len(conditions.starts)} starts"
    )
    each = seconds_each(conditions, some)
    with cluster.workers(scheduler, workers) as found:
        at_once = min(at_once, found.count)
    click.echo(
        f"about {_in_words(each * runs / at_once)} on {at_once} "
        f"{'workers of the scheduler' if scheduler else 'processes'}: a run takes {each:.3f} s, "
        "measured here on a few of them"
    )


def _in_words(seconds: float) -> str:
    """Return a time in seconds, minutes or hours."""
    if seconds < 90.0:
        return f"{max(1.0, seconds):.0f} s"
    if seconds < 5400.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"


@contextlib.contextmanager
def _at_work(
    label: str, scheduler: str | None, workers: int | None
) -> Iterator[tuple[Workers, Callable[[float], None]]]:
    """Yield workers for work that can be resumed, and what takes the fraction done."""
    from adp_path_follower.study.sweeps import cluster

    try:
        with cluster.workers(scheduler, workers) as found, options.progress_bar(label) as progress:
            yield found, progress
    except KeyboardInterrupt:
        click.echo("\nadp: finished work is kept; the same command resumes it", err=True)
        raise


def _tell(found: Results, title: str, directory: FilePath) -> None:
    """Print results and write them into a folder; raise FileError if they cannot be written."""
    from adp_path_follower.study.sweeps.page import write_sweep_page
    from adp_path_follower.study.sweeps.results import results_text, write_results

    click.echo(results_text(found))
    write_results(found, title, directory)
    write_sweep_page(found, title, directory / "report.html")
    best = "best.yaml, " if found.best is not None else ""
    click.echo(f"\nIn {directory}: {best}report.html, findings.json")
