"""`adp replay`: what the controller commands to recorded odometry."""

from __future__ import annotations

import sys
from pathlib import Path

import click
import numpy as np

from adp_path_follower.bags.reader import read_run
from adp_path_follower.bags.replay import Replay, recorded_settings
from adp_path_follower.bags.replay import replay as replay_run
from adp_path_follower.cli.options import FILE, check_writable, settings_options
from adp_path_follower.core.parameter_file import load_settings, parse_assignment
from adp_path_follower.core.schema import update
from adp_path_follower.core.settings import Settings


@click.command()
@click.argument("bag", type=FILE)
@settings_options
@click.option("--csv", "csv_file", type=FILE, metavar="FILE.csv", help="Write both commands.")
@click.option("--figure", "figure_file", type=FILE, metavar="FILE.png", help="Draw both commands.")
def replay(
    bag: Path,
    params: Path | None,
    assignments: tuple[str, ...],
    csv_file: Path | None,
    figure_file: Path | None,
) -> None:
    r"""Feed a bag's odometry and path to the controller again.

    With the recorded parameters, every command must come out the same to the last bit; exit code 1
    if one does not. With others it tells what the controller would have commanded, had the robot
    moved as it did. The bag must come from a run whose control steps were started by odometry
    (control_trigger: odometry, as in `adp demo`).

    \b
    The same again:           adp replay adp_demo_.../bag
    With other parameters:    adp replay adp_demo_.../bag --set max_angular_vel=0.4 --figure w.png
    """
    check_writable(csv_file, figure_file)
    run = read_run(bag)
    changed = params is not None or bool(assignments)
    settings = recorded_settings(run)
    if params is not None:
        settings = load_settings(Settings, "path_follower", params, assignments)
    elif assignments:
        settings = update(settings, dict(map(parse_assignment, assignments)))
    found = replay_run(run, settings)
    click.echo(_report(found, changed))
    if csv_file is not None:
        time = (found.stamp - found.stamp[0]) * 1e-9
        table = np.column_stack([time, found.recorded, found.replayed])
        header = "time,recorded_v,recorded_w,replayed_v,replayed_w"
        np.savetxt(csv_file, table, delimiter=",", header=header, comments="", fmt="%.17g")
    if figure_file is not None:
        from adp_path_follower.analysis.figures import draw_replay

        draw_replay(found, figure_file)
    sys.exit(0 if changed or found.identical.all() else 1)


def _report(found: Replay, changed: bool) -> str:
    """Return how recorded and replayed commands compare."""
    same = found.identical
    lines = [f"{int(same.sum())} of {len(same)} commands are identical to the last bit"]
    if same.all():
        return lines[0]
    first = int(np.argmin(same))
    apart = np.abs(found.replayed - found.recorded)
    lines.append(
        f"first difference after {(found.stamp[first] - found.stamp[0]) * 1e-9:.3f} s: recorded "
        f"v = {found.recorded[first, 0]:.6g} m/s, ω = {found.recorded[first, 1]:.6g} rad/s; "
        f"replayed v = {found.replayed[first, 0]:.6g} m/s, ω = {found.replayed[first, 1]:.6g} rad/s"
    )
    lines.append(
        f"largest difference: {apart[:, 0].max():.3g} m/s and {apart[:, 1].max():.3g} rad/s; RMS "
        f"{np.sqrt((apart[:, 0] ** 2).mean()):.3g} m/s and "
        f"{np.sqrt((apart[:, 1] ** 2).mean()):.3g} rad/s"
    )
    if not changed:
        lines.append(
            "the parameters are the recorded ones: the bag is of another version, or was damaged"
        )
    return "\n".join(lines)
