"""`adp tune`: search for better settings, on all cores or machines."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import click

from adp_path_follower.cli.options import (
    FILE,
    cluster_options,
    progress_bar,
    resumable,
    settings_options,
)
from adp_path_follower.cli.outputs import write_json
from adp_path_follower.extras import require

if TYPE_CHECKING:  # Dask and Optuna are loaded when there is something to run
    from adp_path_follower.study.sweeps.request.request import Tuning


@click.command()
@click.argument("file", type=FILE, metavar="[TUNE.yaml]", required=False)
@settings_options
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
@cluster_options
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
    from adp_path_follower.study.sweeps.request.files import read_tuning, tuning_of_options

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
        _say_how_long(asked, scheduler, workers)
        return
    if directory is None:
        raise click.UsageError("give a folder for the results: --out DIR")
    _run(asked, title, directory, storage, scheduler, workers)


def _say_how_long(asked: Tuning, scheduler: str | None, workers: int | None) -> None:
    from adp_path_follower.study.sweeps.workers.plan import estimate, in_words

    sweep = asked.runs_with(asked.conditions.settings)
    found = estimate(sweep, scheduler, workers)
    at_once = min(found.workers, asked.search.at_once)
    seconds = found.seconds_each * sweep.runs * asked.search.trials / at_once
    click.echo(
        f"{asked.search.trials:,} settings with {sweep.runs:,} runs of "
        f"{asked.conditions.run.duration:g} s each: {asked.search.trials * sweep.runs:,} runs"
    )
    click.echo(
        f"about {in_words(seconds)} on {at_once} processes: a run with the settings before takes "
        f"{found.seconds_each:.3f} s, measured here on a few of them"
    )


def _run(
    asked: Tuning,
    title: str,
    directory: FilePath,
    storage: str | None,
    scheduler: str | None,
    workers: int | None,
) -> None:
    from adp_path_follower.study.sweeps.findings import (
        as_json,
        findings,
        findings_text,
        write_findings,
    )
    from adp_path_follower.study.sweeps.study import open_study, tried
    from adp_path_follower.study.sweeps.study import tune as run_tuning
    from adp_path_follower.study.sweeps.workers import cluster
    from adp_path_follower.study.sweeps.workers.parts_folder import OutputFolder
    from adp_path_follower.study.sweeps.workers.plan import in_words

    begun = time.monotonic()
    trials = asked.search.trials
    with OutputFolder(directory, "tune", asked.description()):
        place = storage or f"sqlite:///{(directory / 'study.db').absolute()}"
        study = open_study(asked, place, shared=storage is not None)
        there = len(tried(study))
        if there:
            click.echo(f"{there:,} of {trials:,} trials are there already", err=True)
        if there < trials:
            with (
                resumable(),
                cluster.workers(scheduler, workers) as found_workers,
                progress_bar(f"trying {trials:,} settings") as progress,
            ):
                run_tuning(study, asked, found_workers, progress)
        found = findings(study, asked)
        click.echo(findings_text(found))
        files = write_findings(found, title, directory)
        write_json(directory / "findings.json", as_json(found))
    names = [*(file.name for file in files), "findings.json"]
    click.echo(f"\nIn {directory}: {', '.join(names)}")
    click.echo(f"\n{found.trials - there:,} trials in {in_words(time.monotonic() - begun)}")
