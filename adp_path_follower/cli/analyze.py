"""`adp analyze`: from the bag of a run to an answer."""

from __future__ import annotations

import itertools
import math
import re
import sys
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import click

from adp_path_follower.cli import options, outputs
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.extras import require

if TYPE_CHECKING:  # Plotly and Jinja2 are wanted when there is something to report
    from adp_path_follower.analysis.bag_analysis import BagAnalysis
    from adp_path_follower.analysis.metrics import Requirement

_ONE_TOPIC = r"(?:odom|cmd|path)=[^,]+"
_WITH_TOPICS = re.compile(rf"(?P<bag>.+?):(?P<topics>{_ONE_TOPIC}(?:,{_ONE_TOPIC})*)")


@click.command()
@click.argument("bags", nargs=-1, required=True, metavar="BAG...")
@options.out_option("report", "report, figures and numbers")
@options.topic_options("path", "cmd", "odom")
@options.settings_options
@click.option(
    "--require",
    "requirements",
    multiple=True,
    metavar="NAME<LIMIT",
    help="Exit with 1 if a bag does not keep this; may be given several times.",
)
def analyze(
    bags: tuple[str, ...],
    directory: FilePath,
    odom: str | None,
    cmd: str | None,
    path: str | None,
    params: FilePath | None,
    assignments: tuple[str, ...],
    requirements: tuple[str, ...],
) -> None:
    r"""Turn the bags of runs into one report.

    A bag is what the recorder or `ros2 bag record` wrote: MCAP or sqlite3, split, compressed. A bag
    of another controller has all figures but the learner's. Several bags are drawn over each other
    and compared in a table; BAG:path=/plan,odom=/odom,cmd=/cmd names topics of one. The path may
    be a file, where the bag has none: --path path.csv. With --params or --set, J is counted alike
    for every bag.

    \b
    One run:            adp analyze my_bag
    Against Nav2:       adp analyze mine nav2:path=/plan,odom=/odom
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
    topics = options.given_topics(odom=odom, cmd=cmd, path=path)
    given = [_bag_and_topics(bag, topics) for bag in bags]
    shared = load_settings(Settings, "path_follower", params, assignments)
    compared = shared if params is not None or assignments else None
    analyses: list[BagAnalysis] = []
    with outputs.output_directory(directory):
        names = names_of([bag for bag, _ in given])
        for number, ((bag, own), name) in enumerate(zip(given, names, strict=True), start=1):
            file = "trajectory.tum" if len(bags) == 1 else f"trajectory_{number}.tum"
            with options.progress_bar(f"reading {name}") as progress:
                analyses.append(
                    analyse_bag(
                        bag.resolve(), own, len(bags), directory / file, progress, name, compared
                    )
                )
        draw_bags(analyses, directory / "figures")
        outputs.write_json(directory / "metrics.json", _numbers(analyses, limits))
        write_report(analyses, limits, directory / "report.html")
    click.echo(metrics_table(analyses))
    for note in dict.fromkeys(f"{item.name}: {note}" for item in analyses for note in item.notes):
        click.echo(f"adp: {note}", err=True)
    missed = _missed(analyses, limits)
    for text in missed:
        click.echo(f"adp: {text}", err=True)
    click.echo(f"\nIn {directory}: report.html, metrics.json, figures/, trajectory*.tum")
    click.echo((directory / "report.html").resolve().as_uri())
    sys.exit(1 if missed else 0)


def _bag_and_topics(text: str, topics: dict[str, str]) -> tuple[FilePath, dict[str, str]]:
    """Return the bag and the topics that BAG:path=/plan,odom=/odom means."""
    match = _WITH_TOPICS.fullmatch(text)
    if match is None or FilePath(text).exists():
        return FilePath(text), topics
    own = dict(item.split("=", 1) for item in match["topics"].split(","))
    return FilePath(match["bag"]), {**topics, **options.given_topics(**own)}


def _missed(analyses: list[BagAnalysis], limits: list[Requirement]) -> list[str]:
    """Return a sentence for each requirement that a bag does not keep."""
    missed = []
    for limit, item in itertools.product(limits, analyses):
        if not item.meets(limit):
            value, doubt = item.numbers.get(limit.name, math.nan), item.trust.doubt(limit.name)
            found = "not known" if math.isnan(value) else f"{value:.6g}"
            found += f", hardly measured: {doubt}" if doubt else ""
            missed.append(
                f"required {limit.text} is not met by {item.name}: {limit.name} is {found}"
            )
    return missed


def _numbers(analyses: list[BagAnalysis], limits: list[Requirement]) -> dict[str, Any]:
    return {
        "bags": [
            {
                "name": item.name,
                "metrics": dict(item.metrics),
                "time_in_state": dict(item.states),
                "topics": dict(item.topics),
                "trust": vars(item.trust),
                "notes": list(item.notes),
            }
            for item in analyses
        ],
        "requirements": [
            {"text": limit.text, "met": [item.meets(limit) for item in analyses]}
            for limit in limits
        ],
    }
