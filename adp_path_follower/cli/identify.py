"""`adp identify`: the robot that a bag shows."""

from __future__ import annotations

import math
from pathlib import Path as FilePath
from typing import TYPE_CHECKING

import click

from adp_path_follower.cli import options, outputs
from adp_path_follower.core.files import write_output

if TYPE_CHECKING:  # scipy's solvers, which `--help` need not wait for
    from adp_path_follower.analysis.identification.identify import Identification


@click.command()
@click.argument("bags", nargs=-1, required=True, metavar="BAG...")
@options.out_option("identify", "robot.yaml and the figure")
@options.topic_options("pose", "cmd", "odom")
@outputs.json_option("Write the parameters with their intervals")
def identify(
    bags: tuple[str, ...],
    directory: FilePath,
    odom: str | None,
    cmd: str | None,
    pose: str | None,
    json_file: FilePath | None,
) -> None:
    r"""Find delay, lag, gains, bias and noise of the robot that drove in some bags.

    Any bag with odometry and velocity commands will do, of Nav2 or another controller, too; several
    are taken together. Gains and bias come from the pose, so it must be localised: if odometry is
    the integral of the encoders, name a topic that is better by --pose.

    \b
    A drive for it, recorded:
        ros2 launch adp_path_follower follow.launch.py use_sim:=false \
            path:=identify record:=true
    Its robot:
        adp identify adp_run_DATE --out robot
    Try it:
        adp simulate --params robot/robot.yaml --robot robot/robot.yaml

    Prints each parameter with an interval of 95 %, or which drive would tell it. Writes robot.yaml
    (robot_model: given for the controller, and the same robot for the simulator) and robot.png.
    """
    from adp_path_follower.analysis.identification.identify import identify as identified
    from adp_path_follower.analysis.identification.recording import read_recording
    from adp_path_follower.drawing.run_figures import draw_robot

    topics = options.given_topics(odom=odom, cmd=cmd, pose=pose)
    with outputs.output_directory(directory):
        found = identified([read_recording(FilePath(bag), topics) for bag in bags])
        head = f"# The robot of {', '.join(FilePath(bag).name for bag in bags)}, by adp identify.\n"
        write_output(directory / "robot.yaml", head + found.parameter_file())
        draw_robot(found.courses, directory / "robot.png")
    click.echo(_table(found))
    for note in found.notes:
        click.echo(f"adp: {note}", err=True)
    if any(item.drive for item in found.parameters):
        click.echo("adp: --path identify is a short slalom that tells all of them", err=True)
    click.echo(f"\nIn {directory}: robot.yaml, robot.png")
    if json_file is not None:
        numbers = {item.name: vars(item) for item in found.parameters}
        explained = dict(zip("vw", found.explained, strict=True))
        outputs.write_json(
            json_file, {"parameters": numbers, "explained": explained, "notes": found.notes}
        )


def _table(found: Identification) -> str:
    lines = [f"{'':18}{'value':>10}     95 % interval"]
    for item in found.parameters:
        if item.drive:
            lines.append(f"{item.name:18}{'not told':>10}     {item.drive}")
        elif math.isfinite(item.value):
            interval = f"{item.low:.4g} … {item.high:.4g} {item.unit}".rstrip()
            lines.append(f"{item.name:18}{item.value:10.4g}     {interval}")
        else:
            lines.append(f"{item.name:18}{'–':>10}")
    shares = [
        f"{100.0 * share:.1f} % of {name}"
        for name, share in zip("vω", found.explained, strict=True)
        if math.isfinite(share)
    ]
    lines += [f"the model explains {' and '.join(shares)}"] if shares else []
    return "\n".join(lines)
