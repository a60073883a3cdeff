"""`adp replay`: what the controller commands to recorded odometry."""

import contextlib
import sys
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path as FilePath

import click
import numpy as np
from click.core import ParameterSource

from adp_path_follower.bags.reader import Run, read_run
from adp_path_follower.cli import options, outputs
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings, parse_assignment
from adp_path_follower.extras import require
from adp_path_follower.study.replay.replay import ComparedWeights, Replay, compare_weights, rerun
from adp_path_follower.study.replay.replay import replay as replay_run
from adp_path_follower.study.replay.write_bag import write_replay


@click.command()
@click.argument("bag", type=options.FILE)
@options.topic_options("path", "cmd", "odom")
@options.settings_options
@click.option(
    "--closed-loop",
    is_flag=True,
    help="Drive the simulator from the recorded initial pose, instead of the recorded motion.",
)
@options.file_option(
    "--out",
    "directory",
    "Where bag and report go: a new or empty directory (adp_replay_DATE if it is not given, and "
    "other parameters or --closed-loop are).",
    "DIR",
)
@options.file_option("--csv", "csv_file", "Write both commands.", "FILE.csv")
@options.file_option("--figure", "figure_file", "Draw both commands.", "FILE.png")
@click.option("--report", is_flag=True, help="Write bag and report also where nothing was changed.")
@click.option(
    "--republish",
    is_flag=True,
    help="Play odometry, path and /clock to a live controller, which must run with "
    "use_sim_time:=true.",
)
@click.option(
    "--rate",
    type=click.FloatRange(0.01, 100.0),
    default=1.0,
    show_default=True,
    help="Seconds of the bag in one second, for --republish.",
)
def replay(
    bag: FilePath,
    odom: str | None,
    cmd: str | None,
    path: str | None,
    params: FilePath | None,
    assignments: tuple[str, ...],
    closed_loop: bool,
    directory: FilePath | None,
    csv_file: FilePath | None,
    figure_file: FilePath | None,
    report: bool,
    republish: bool,
    rate: float,
) -> None:
    r"""Feed a bag's odometry and path to the controller again.

    With the recorded parameters, every command and every weight must come out the same to the last
    bit; exit code 1 if one does not, with a line that says when and by how much it first differs.
    With others it tells what the controller would have commanded, had the robot moved as it did,
    and with --closed-loop how the robot would have moved: in a bag, and in a report that lays both
    over each other.

    \b
    The same again:           adp replay adp_demo_.../bag
    With other parameters:    adp replay my_bag --set max_angular_vel=0.4
    How it would have moved:  adp replay my_bag --params other.yaml --closed-loop
    To a live controller:     adp replay my_bag --republish --rate 2
    """
    _refuse_contradictions(republish, closed_loop)
    outputs.check_writable(csv_file, figure_file)
    outputs.check_figure(figure_file)
    run = read_run(bag, options.given_topics(odom=odom, cmd=cmd, path=path))
    for note in run.notes:
        click.echo(f"adp: {note}", err=True)
    if republish:
        _republish(bag, run, rate)
        return
    # Settings that replace the recorded ones, or values that overlay them.
    settings, overlay = None, dict(map(parse_assignment, assignments))
    if params is not None:
        settings, overlay = load_settings(Settings, "path_follower", params, assignments), {}
    changed = settings is not None or bool(overlay)
    name = datetime.now().strftime("adp_replay_%Y_%m_%d-%H_%M_%S")
    is_kept = directory is not None or closed_loop or changed or report
    output = (
        outputs.output_directory(directory or FilePath(name))
        if is_kept
        else contextlib.nullcontext()
    )
    with output as folder:
        velocity: FloatArray | None = None
        differs = False
        if closed_loop:
            found, velocity = rerun(run, settings, overlay)
        else:
            found = replay_run(run, settings, overlay)
            # With other parameters other weights are what was asked for.
            weights = None if changed else compare_weights(run, found)
            click.echo(_report(run, found, weights))
            differs = weights is not None and _differs(found, weights)
        _write_comparison(found, csv_file, figure_file)
        if folder is not None:
            replayed = folder / f"{bag.resolve().stem}_replayed"
            write_replay(found, bag, run.topics, replayed, velocity)
            _write_report(bag, run.topics, replayed, closed_loop)
    sys.exit(1 if differs else 0)


def _refuse_contradictions(republish: bool, closed_loop: bool) -> None:
    """Raise AdpError for options that would do nothing beside others; the sentence names both."""
    context = click.get_current_context()
    settings, comparisons = ("params", "assignments"), ("csv_file", "figure_file")
    rules = (
        (
            republish,
            "--republish plays what was recorded to a controller with settings of its own",
            (*settings, "closed_loop", "directory", "report", *comparisons),
        ),
        (not republish, "without --republish nothing is played", ("rate",)),
        (
            closed_loop,
            "--closed-loop has other steps than the recording, so none to compare",
            comparisons,
        ),
    )
    for applies, reason, names in rules:
        for option in context.command.params:
            source = context.get_parameter_source(option.name or "")
            if applies and option.name in names and source is ParameterSource.COMMANDLINE:
                raise AdpError(f"{reason}: not with {option.opts[0]}")


def _republish(bag: FilePath, run: Run, rate: float) -> None:
    require("adp replay --republish", "jazzy")
    from adp_path_follower.study.replay.republish import republish

    for key in ("odom", "path"):
        if key not in run.topics:
            raise AdpError(f"bag {bag} has no topic named '{key}': name one by --{key}")
    commands = run.series.get("cmd_vel")
    begun = None
    if commands is not None and commands.values.any():
        begun = int(commands.arrival[commands.values.any(axis=1)][0])
    with options.progress_bar("playing") as progress:
        count, damaged = republish(bag, run.topics, begun, rate, progress)
    click.echo(f"played {count} messages")
    if damaged:
        click.echo(f"adp: {damaged} messages cannot be decoded: passed over", err=True)


def _write_comparison(
    found: Replay, csv_file: FilePath | None, figure_file: FilePath | None
) -> None:
    """Write recorded and replayed commands as a table, and as a picture."""
    if csv_file is not None:
        table = np.column_stack([found.time, found.recorded, found.replayed])
        header = "time,recorded_v,recorded_w,replayed_v,replayed_w"
        with outputs.whole_file(csv_file) as file:
            np.savetxt(file, table, delimiter=",", header=header, comments="", fmt="%.17g")
    if figure_file is not None:
        from adp_path_follower.drawing.figure_style import COLORS
        from adp_path_follower.drawing.run_figures import draw_over_time

        recorded = found.time, found.recorded, {"color": "0.6", "linewidth": 3, "label": "recorded"}
        replayed = found.time, found.replayed, {"color": COLORS[1], "label": "replayed"}
        title, labels = "Commands to the recorded odometry", ("v [m/s]", "ω [rad/s]")
        with outputs.whole_file(figure_file) as file:
            draw_over_time(file, title, labels, [recorded, replayed])


def _write_report(
    bag: FilePath, topics: Mapping[str, str], replayed: FilePath, closed_loop: bool
) -> None:
    """Write a report of the recorded and the new run, as `adp analyze` does."""
    recorded = {key: topics[key] for key in ("odom", "cmd_vel", "path") if key in topics}
    # The new commands, and the odometry of a simulator, are there by their usual names.
    new = {key: topic for key, topic in recorded.items() if key == "path" or not closed_loop}
    new["cmd_vel"] = "/cmd_vel"
    directory = replayed.parent
    try:
        require("the report", "report")
    except AdpError as error:
        click.echo(f"In {directory}: {replayed.name}/, without a report: {error}")
        return
    from adp_path_follower.analysis.bag_analysis import analyse_bag
    from adp_path_follower.analysis.bag_page import write_report

    analyses = []
    runs = (("recorded", bag, recorded), ("replayed", replayed, new))
    for number, (label, source, names) in enumerate(runs, start=1):
        with options.progress_bar(f"reading the {label} run") as progress:
            file = directory / f"trajectory_{number}.tum"
            analyses.append(analyse_bag(source.resolve(), names, 2, file, progress))
    write_report(analyses, [], directory / "report.html")
    click.echo(f"In {directory}: report.html, {replayed.name}/ (rosbag2, MCAP), trajectory_*.tum")
    click.echo((directory / "report.html").resolve().as_uri())


def _report(run: Run, found: Replay, weights: ComparedWeights | None) -> str:
    """Return how recorded and replayed commands compare, and weights where they should agree."""
    same = found.identical[found.answered]
    if not len(same):
        lines = [
            f"{len(found.steps.stamp)} steps replayed; the bag has no commands to compare with"
        ]
    else:
        lines = [f"{int(same.sum())} of {len(same)} commands are identical to the last bit"]
    if not same.all():
        lines += _differences(found)
    if weights is None:
        return "\n".join(lines)
    if len(weights.identical):
        count, total = int(weights.identical.sum()), len(weights.identical)
        lines.append(f"{count} of {total} sets of weights are, too")
    lines += [*filter(None, [weights.difference]), *weights.notes]
    if _differs(found, weights):
        lines.append(_cause(run, found))
    return "\n".join(lines)


_FIRST_STEPS = 20  # of which a recorder that began in time has at least one


def _cause(run: Run, found: Replay) -> str:
    """Return why commands with the recorded parameters may differ."""
    spent = run.series.get("cost")
    if spent is not None and float(spent.values[0, 0]) > found.cost[:_FIRST_STEPS].max():
        return (
            "the bag begins after the run: the controller had driven before its first recorded "
            f"step (cost to date {float(spent.values[0, 0]):.4g}), and what it had learned is not "
            "in the bag; start the recorder before the controller"
        )
    return "the parameters are the recorded ones: the bag is of another version, or was damaged"


def _differs(found: Replay, weights: ComparedWeights) -> bool:
    """Return whether any command or weight is another than the recorded one."""
    return bool(weights.difference) or not found.identical[found.answered].all()


def _differences(found: Replay) -> list[str]:
    """Return where commands first differ, and by how much."""
    answered = found.answered
    time = found.time[answered]
    recorded, replayed = found.recorded[answered], found.replayed[answered]
    first = int(np.argmin(found.identical[answered]))
    apart = np.abs(replayed - recorded)
    largest = np.maximum(apart.max(axis=0), 1e-300)  # whose square may overflow
    rms = largest * np.sqrt(((apart / largest) ** 2).mean(axis=0))
    return [
        f"first difference after {time[first]:.3f} s: recorded v = {recorded[first, 0]:.6g} m/s, "
        f"ω = {recorded[first, 1]:.6g} rad/s; replayed v = {replayed[first, 0]:.6g} m/s, "
        f"ω = {replayed[first, 1]:.6g} rad/s",
        f"largest difference: {apart[:, 0].max():.3g} m/s and {apart[:, 1].max():.3g} rad/s; RMS "
        f"{rms[0]:.3g} m/s and {rms[1]:.3g} rad/s",
    ]
