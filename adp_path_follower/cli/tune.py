"""`adp tune`: search for better settings, on all cores or machines."""

import dataclasses
import time
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import click

from adp_path_follower.cli import options
from adp_path_follower.cli.sweep import at_work, in_words, needed, say_how_long, tell
from adp_path_follower.extras import require

if TYPE_CHECKING:  # Dask and Optuna are loaded when there is something to run
    from adp_path_follower.study.sweeps.request.request import Tuning


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
    from adp_path_follower.study.sweeps.request.request import read_tuning, tuning_of_options

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
        say_how_long(asked.conditions, before, count, at_once, scheduler, workers)
        return
    _search(asked, title, needed(directory), storage, scheduler, workers)


def _search(
    asked: "Tuning",
    title: str,
    directory: FilePath,
    storage: str | None,
    scheduler: str | None,
    workers: int | None,
) -> None:
    """Try what is left of a search, and tell and write what was found."""
    from adp_path_follower.study.sweeps.results import results
    from adp_path_follower.study.sweeps.study import open_study, tried
    from adp_path_follower.study.sweeps.study import tune as run_tuning
    from adp_path_follower.study.sweeps.workers.folder import OutputFolder

    begun, trials = time.monotonic(), asked.search.trials
    with OutputFolder(directory, "tune", asked.description()):
        place = storage or f"sqlite:///{(directory / 'study.db').absolute()}"
        study = open_study(asked, place, shared=storage is not None)
        there = len(tried(study))
        if there:
            click.echo(f"{there:,} of {trials:,} trials are there already", err=True)
        if there < trials:
            with at_work(f"trying {trials:,} settings", scheduler, workers) as (found, progress):
                run_tuning(study, asked, found, progress)
        tell(results(study, asked), title, directory)
        fresh = len(tried(study)) - there
    click.echo(f"{fresh:,} trials in {in_words(time.monotonic() - begun)}")
