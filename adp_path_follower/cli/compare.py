"""`adp compare`: the controller beside its peers."""

from __future__ import annotations

import math
import sys
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from adp_path_follower.cli import options, outputs
from adp_path_follower.core.files import output_to
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.library import PATH_HELP, named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.robot import ROBOT_MODELS
from adp_path_follower.drawing.page import Card, Table, write_runs_page
from adp_path_follower.extras import is_installed
from sim_unicycle.fault_script import without_nodes
from sim_unicycle.settings import SimulatorSettings

if TYPE_CHECKING:  # with its solvers, for which `--help` need not wait
    from adp_path_follower.study.comparison.compare import Comparison, Outcome

# Column -> width and digits in the text, and digits in the race's table.
_COLUMNS = {"J/J*, median": (9, 4, 4), "95 %": (9, 4, 4), "max": (9, 4, 4), "failed": (8, 0, 0)}
_COLUMNS |= {"settled in [s]": (9, 2, 2), "effort": (8, 3, 3), "cross-track RMS [mm]": (10, 2, 3)}
_COLUMNS |= {"max [mm]": (9, 2, 2), "per step [ms]": (11, 3, 3)}
_UNLIMITED = ("min_linear_vel=-.inf", "max_linear_vel=.inf", "max_angular_vel=.inf")


@click.command()
@options.settings_options
@options.simulator_options
@click.option(
    "--path",
    "path_names",
    multiple=True,
    metavar="NAME|FILE",
    help=f"Path to follow, lissajous if none is given; may be given several times: {PATH_HELP}.",
)
@options.start_options
@click.option("--duration", type=float, default=30.0, show_default=True, help="Time [s] of J.")
@click.option(
    "--controllers",
    metavar="NAME,NAME",
    help="Which ones; all if not given. `--list` names them.",
)
@click.option("--list", "list_them", is_flag=True, help="Name the controllers, and end.")
@click.option("--unlimited", is_flag=True, help="Without limits of the command.")
@options.out_option("compare", "table, figures, numbers and the page of the race")
def compare(
    params: FilePath | None,
    assignments: tuple[str, ...],
    simulator: SimulatorSettings,
    path_names: tuple[str, ...],
    starts: tuple[tuple[float, float, float], ...],
    starts_file: FilePath | None,
    start_arc_length: float,
    duration: float,
    controllers: str | None,
    list_them: bool,
    unlimited: bool,
    directory: FilePath,
) -> None:
    r"""Compare the controller with its peers, and all with the offline optimum.

    Every controller runs from the same starts (forty, with |s|, |y| <= 1 m and |θ| <= 60°, if none
    are given) for the cost J, and one lap from the paper's start for the cross-track error. A run
    has failed if it was lost or ended more than 0.5 m from the path. All have the same speed along
    the path and limits of acceleration, from rest on; limits of jerk are refused. Needs no
    ROS; about four minutes for each path, most of it for nmpc and the optimum.

    \b
    The headline:       adp compare --unlimited
    With limits, fast:  adp compare --controllers adp,lqr,regulated_pure_pursuit
    Before a bend:      adp compare --unlimited --start-arc-length 15.53
    A real robot:       adp compare --robot turtlebot4 --params turtlebot4

    With --robot, all see the same noise, J* is that of the robot known in full, and eight of the
    starts are run. Peers come as published and on our estimator and model (lqr+learned), adp with
    each model (ideal, learned, given). --controllers takes such names, too.

    Exit code 1 if some start has no known optimum; it is named, and counts in all but J/J*.
    """
    from adp_path_follower.study.comparison.compare import compare as run_comparison
    from adp_path_follower.study.comparison.controllers import PEERS, known_controllers
    from adp_path_follower.study.simulation.simulate import read_starts

    if list_them:
        for name, description in known_controllers().items():
            click.echo(f"{name:30} {description}")
        return
    names = list(known_controllers())
    plant, faults = without_nodes(simulator)
    if not plant.ideal:
        own = [f"adp+{model}" for model in ROBOT_MODELS]
        names = [*own, *PEERS, *(f"{name}+learned" for name in PEERS)]
    if controllers is not None:
        names = [name.strip() for name in controllers.split(",")]
    changes = (*_UNLIMITED, *assignments) if unlimited else assignments
    settings = load_settings(Settings, "path_follower", params, changes)
    if starts or starts_file is not None:
        errors = options.collect_starts(starts, starts_file)
    else:
        # A robot's model drives one run at a time, which takes long.
        errors = read_starts()[:: 5 if any("+" in name for name in names) else 1]
    paths = {name: named_path(name, settings.path) for name in path_names or ("lissajous",)}
    found: list[Comparison] = []
    with outputs.output_directory(directory, keep=True):
        for name, path in paths.items():
            with options.progress_bar(f"{len(names)} controllers on {name}") as progress:
                item = run_comparison(
                    settings,
                    name,
                    path,
                    errors,
                    names,
                    start_arc_length=start_arc_length,
                    duration=duration,
                    plant=plant,
                    faults=faults,
                    progress=progress,
                )
            found.append(item)
            click.echo(_table(item) + "\n")
            for problem in item.problems:
                click.echo(f"adp: {problem}", err=True)
            # After each path, so that what was found stays if a later one is interrupted.
            figures = directory if len(paths) == 1 else directory / f"path_{len(found)}"
            _write(found, [settings, simulator], directory, figures)
    click.echo(f"In {directory}: compare.txt, compare.json, race.html and the figures")
    for page in sorted(directory.rglob("race.html")):
        click.echo(page.resolve().as_uri())
    sys.exit(1 if any(item.problems for item in found) else 0)


def _table(found: Comparison) -> str:
    """Return one path's table, best controllers first."""
    known = int(np.isfinite(found.optimal_cost).sum())
    lines = [
        f"{found.path_name}, {len(found.starts)} starts"
        + (f", J* known of {known}" if known < len(found.starts) else ""),
        f"{'J/J*':>48}                            settled  effort   cross-track [mm]   per step",
        "controller                             median      p95      max  failed   in [s]  ∫uᵀRu"
        "       RMS      max       [ms]",
    ]
    lines += [_line(item) for item in sorted(found.outcomes, key=_rank)]
    if any(item.failed.any() for item in found.outcomes):
        lines.append("effort is the median of the runs that did not fail; J/J* counts all")
    return "\n".join([*lines, *found.notes])


def _line(item: Outcome) -> str:
    values = _columns(item)
    numbers = zip(values[3:], [*_COLUMNS.values()][3:], strict=True)
    cells = [*map(_ratio, values[:3]), *(_number(value, *form[:2]) for value, form in numbers)]
    return f"{item.name:37}{''.join(cells)}"


def _columns(item: Outcome) -> tuple[float, ...]:
    """Return J/J* (median, 95 %, largest), failed runs, time, effort, distances [mm], step [ms]."""
    return (
        *(item.quantile(share) for share in (0.5, 0.95, 1.0)),
        float(item.failed.sum()),
        _median(item.settling_time),
        _median(item.effort[~item.failed]),
        1e3 * item.cross_track_rms,
        1e3 * item.cross_track_max,
        1e3 * item.step_time,
    )


def _median(values: FloatArray) -> float:
    """Return the median of values (N,) but for NaN; NaN if there are no others."""
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else math.nan


def _texts(item: Outcome) -> list[str]:
    """Return the columns as the page shows them."""
    values = _columns(item)
    numbers = zip(values[3:], [*_COLUMNS.values()][3:], strict=True)
    ratios = [_ratio(value).strip() for value in values[:3]]
    return [*ratios, *(_number(value, 0, digits) for value, (*_, digits) in numbers)]


def _number(value: float, width: int, digits: int) -> str:
    """Return a number of a table, or a dash."""
    return f"{value:{width}.{digits}f}" if np.isfinite(value) else f"{'–':>{width}}"


def _rank(item: Outcome) -> tuple[float, float]:
    """Return by what controllers are sorted: J/J*, then J of the runs that were not lost."""
    ratio, cost = item.quantile(0.5), _median(item.cost)
    return (ratio if math.isfinite(ratio) else math.inf, math.inf if math.isnan(cost) else cost)


def _ratio(value: float) -> str:
    if np.isnan(value):
        return f"{'–':>9}"
    return f"{value:9.4f}" if value < 100.0 else f"{'>100' if np.isfinite(value) else 'failed':>9}"


def _write(
    found: list[Comparison], settings: list[object], directory: FilePath, figures: FilePath
) -> None:
    """Write table and numbers of all paths so far, and the figures of the last one."""
    from adp_path_follower.study.comparison.figures import draw_comparison

    text = "\n\n".join(_table(item) for item in found)
    with output_to(directory):
        (directory / "compare.txt").write_text(text + "\n", encoding="utf-8")
        outputs.write_json(
            directory / "compare.json", {"paths": [_numbers(item) for item in found]}
        )
        draw_comparison(found[-1], figures)
        if is_installed("report"):
            _write_race(found[-1], settings, figures / "race.html")


def _write_race(found: Comparison, settings: list[object], file: FilePath) -> None:
    """Write the page on which all controllers start together."""
    ranked = sorted(found.outcomes, key=_rank)
    rows = []
    for item in ranked:
        cells = zip(_texts(item), _columns(item), strict=True)
        rows.append(((item.name, math.nan), *cells))
    about = (
        f"Every controller drives one lap of {found.path_name} from the paper's start, with the "
        "same target, cost and limits. The table compares J with the offline optimum J* from "
        f"{len(found.starts)} start{'s' * (len(found.starts) > 1)}, and the distance from the "
        "path over the lap after 10 s. The lowest curve of the cost is the best."
    )
    runs = [item.lap for item in ranked]
    title = f"Race of {len(runs)} controllers on {found.path_name}"
    table = Table(("controller", *_COLUMNS), tuple(rows))
    write_runs_page(file, title, about, "adp compare", settings, _cards(ranked[0]), runs, table)


def _cards(best: Outcome) -> tuple[Card, ...]:
    """Return what the page of the race shows first: the best controller's numbers."""
    shown = dict(zip(_COLUMNS, _texts(best), strict=True))
    ranked_by = "J" if np.isnan(best.quantile(0.5)) else "J / J*"
    return (
        ("ahead", best.name, f"the least median of {ranked_by}"),
        ("J / J*", shown["J/J*, median"], f"its median; {shown['max']} at most, and 1 is the best"),
        (
            "distance from the path [mm]",
            shown["cross-track RMS [mm]"],
            f"root mean square; at most {shown['max [mm]']}",
        ),
        ("settled after [s]", shown["settled in [s]"], "median"),
        ("time of a step [ms]", shown["per step [ms]"], "median of one robot's steps"),
    )


def _numbers(found: Comparison) -> dict[str, Any]:
    quantiles = {"cost_ratio_median": 0.5, "cost_ratio_p95": 0.95, "cost_ratio_max": 1.0}
    names = ["cost", "failed", "settling_time", "effort", "cross_track_rms", "cross_track_max"]
    return {
        "path": found.path_name,
        "starts": found.starts,
        "optimal_cost": found.optimal_cost,
        "problems": found.problems,
        "notes": found.notes,
        "controllers": [
            {
                "name": item.name,
                **{name: item.quantile(share) for name, share in quantiles.items()},
                **{name: getattr(item, name) for name in [*names, "step_time"]},
            }
            for item in found.outcomes
        ],
    }
