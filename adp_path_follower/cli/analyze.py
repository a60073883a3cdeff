"""`adp analyze`: from the bag of a run to an answer."""

from __future__ import annotations

import itertools
import math
import sys
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import click

from adp_path_follower.cli.options import (
    FILE,
    given_topics,
    out_option,
    progress_bar,
    topic_options,
)
from adp_path_follower.cli.outputs import output_directory, write_json
from adp_path_follower.extras import require

if TYPE_CHECKING:  # Plotly and Jinja2 are wanted when there is something to report
    from adp_path_follower.analysis.bag_analysis import BagAnalysis
    from adp_path_follower.analysis.metrics import Requirement


@click.command()
@click.argument("bags", nargs=-1, required=True, type=FILE, metavar="BAG...")
@out_option("report", "report, figures and numbers")
@topic_options
@click.option(
    "--require",
    "requirements",
    multiple=True,
    metavar="NAME<LIMIT",
    help="Exit with 1 if a bag does not keep this; may be given several times.",
)
def analyze(
    bags: tuple[FilePath, ...],
    directory: FilePath,
    odom: str | None,
    cmd: str | None,
    path: str | None,
    requirements: tuple[str, ...],
) -> None:
    r"""Turn the bags of runs into one report.

    A bag is what the recorder or `ros2 bag record` wrote: MCAP or sqlite3, split, compressed. A bag
    of another controller has all figures but the learner's. Several bags are drawn over each other
    and compared in a table.

    \b
    One run:            adp analyze my_bag
    Against Nav2:       adp analyze my_bag nav2_bag --path /plan
    In CI:              adp analyze my_bag --require 'cross_track_rms<0.02'

    Writes report.html (one file, opens without network), metrics.json, figures/ and
    trajectory.tum, which the tool evo reads. Exit code 1 if a requirement is not met.
    """
    require("adp analyze", "report")
    from adp_path_follower.analysis.bag_analysis import analyse_bag, metrics_table, names_of
    from adp_path_follower.analysis.bag_page import write_report
    from adp_path_follower.analysis.bag_pngs import draw_bags
    from adp_path_follower.analysis.metrics import parse_requirement

    limits = [parse_requirement(text) for text in requirements]
    topics = given_topics(odom=odom, cmd=cmd, path=path)
    analyses: list[BagAnalysis] = []
    with output_directory(directory):
        for number, (bag, name) in enumerate(zip(bags, names_of(bags), strict=True), start=1):
            file = "trajectory.tum" if len(bags) == 1 else f"trajectory_{number}.tum"
            with progress_bar(f"reading {name}") as progress:
                analyses.append(
                    analyse_bag(bag.resolve(), topics, len(bags), directory / file, progress, name)
                )
        draw_bags(analyses, directory / "figures")
        write_json(directory / "metrics.json", _numbers(analyses, limits))
        write_report(analyses, limits, directory / "report.html")
    click.echo(metrics_table(analyses))
    for note in dict.fromkeys(f"{item.name}: {note}" for item in analyses for note in item.notes):
        click.echo(f"adp: {note}", err=True)
    missed = _missed(analyses, limits)
    for text in missed:
        click.echo(f"adp: {text}", err=True)
    click.echo(f"\nIn {directory}: report.html, metrics.json, figures/, trajectory*.tum")
    sys.exit(1 if missed else 0)


def _missed(analyses: list[BagAnalysis], limits: list[Requirement]) -> list[str]:
    """Return a sentence for each requirement that a bag does not keep."""
    missed = []
    for limit, item in itertools.product(limits, analyses):
        if not limit.met(item.numbers):
            value = item.numbers.get(limit.name, math.nan)
            found = "not known" if math.isnan(value) else f"{value:.6g}"
            missed.append(
                f"required {limit.text} is not met by {item.name}: {limit.name} is {found}"
            )
    return missed


def _numbers(analyses: list[BagAnalysis], limits: list[Requirement]) -> dict[str, Any]:
    """Return what metrics.json holds."""
    return {
        "bags": [
            {
                "name": item.name,
                "metrics": dict(item.metrics),
                "time_in_state": dict(item.states),
                "topics": dict(item.topics),
                "notes": list(item.notes),
            }
            for item in analyses
        ],
        "requirements": [
            {"text": limit.text, "met": [limit.met(item.numbers) for item in analyses]}
            for limit in limits
        ],
    }
