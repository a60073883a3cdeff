"""`adp demo`: the paper's path and start, with real ROS 2 nodes."""

from __future__ import annotations

import math
import os
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from adp_path_follower.cli import options, outputs
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.path.nearest import best_place
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.extras import require
from adp_path_follower.study.simulation.simulate import PAPER_START
from sim_unicycle.fault_script import read_fault_script
from sim_unicycle.settings import SimulatorSettings

if TYPE_CHECKING:
    from adp_path_follower.analysis.bag_analysis import BagAnalysis

_TO_ARRIVE = 20.0  # [s] that a robot may need longer to the end of its path
# [Hz] unless another is set: the replay needs no debug topics, and the page shows few of them.
_DEBUG_RATE = 20.0


@click.command()
@options.settings_options
@options.simulator_options
@options.path_option
@options.out_option("demo", "bag, figures and report")
@click.option(
    "--duration",
    type=click.FloatRange(1.0, 3600.0),
    help="Simulated time [s]; without it, one lap or the whole path.",
)
@click.option("--open", "open_page", is_flag=True, help="Open the page in a browser at the end.")
def demo(
    params: FilePath | None,
    assignments: tuple[str, ...],
    simulator: SimulatorSettings,
    path_name: str,
    directory: FilePath,
    duration: float | None,
    open_page: bool,
) -> None:
    r"""Drive the paper's figure eight with real ROS 2 nodes.

    Starts the controller, the unicycle simulator, the path publisher and the recorder as
    processes on a ROS domain of their own, in simulated time and in lock-step: as fast as this
    machine can, and with the same commands on every machine. Then it draws the paper's figures 2
    to 5 from the bag, writes its page and prints its numbers as `adp analyze` does, and says how
    many commands PathFollower repeats exactly. Debug topics tell 20 steps a second, unless
    debug_rate is set.

    \b
    The recommended settings:        adp demo
    The paper's laws and constants:  adp demo --params config/paper.yaml
    With other parameters:           adp demo --set target_gain=0.3
    On a circle of 2 m radius:       adp demo --path circle:0.5
    A bad day, in real time:         adp demo --sim-set fault_script=bad_day
    """
    settings = load_settings(Settings, "path_follower", params, assignments)
    if math.isinf(settings.controller.debug_rate):
        settings = settings.with_changes(debug_rate=_DEBUG_RATE)
    read_fault_script(simulator.simulation.fault_script)
    path = named_path(path_name)
    require("adp demo", "jazzy")
    outputs.new_directory(directory)
    started = time.monotonic()
    if duration is None:
        duration = path.length / settings.target.desired_speed
        duration += 0.0 if path.closed else _TO_ARRIVE
    bag = _run(settings, simulator, path, path_name, duration, directory)
    name = f"demo on {FilePath(path_name).name}"
    page = _report(bag, name, directory, duration, time.monotonic() - started)
    if page is not None:
        click.echo(page.resolve().as_uri())
        if open_page:
            click.launch(page.resolve().as_uri())


def _run(
    settings: Settings,
    simulator: SimulatorSettings,
    path: Path,
    path_name: str,
    duration: float,
    directory: FilePath,
) -> FilePath:
    """Run the nodes with a progress bar and return the bag."""
    from adp_path_follower.study.demo import Progress, run_closed_loop

    shown = 0.0
    bar: Any
    with click.progressbar(
        length=1000,
        label="driving",
        bar_template="%(label)s  [%(bar)s]  %(info)s",
        item_show_func=lambda text: text or "starting the nodes",
        width=30,
        show_eta=False,
    ) as bar:

        def report(progress: Progress | None) -> None:
            nonlocal shown
            now = time.monotonic()
            if now - shown < 0.2:  # [s] between two looks at the bar
                return
            shown = now
            if progress is None:
                bar.render_progress()
                return
            lap = float(best_place(path, progress.target_pose)[0]) / path.length
            distance = np.linalg.norm(progress.error[:2])
            text = (
                f"{progress.time:5.1f} s of {duration:g} s, {100.0 * lap:3.0f} % of the "
                f"{'lap' if path.closed else 'path'}, error {1000.0 * distance:7.1f} mm"
            )
            bar.update(int(1000.0 * min(1.0, progress.time / duration)) - bar.pos, text)

        bag = run_closed_loop(
            settings, path, path_name, np.array(PAPER_START), duration, directory, report, simulator
        )
        bar.update(1000 - bar.pos)
    return bag


def _report(
    bag: FilePath, name: str, directory: FilePath, duration: float, wall_time: float
) -> FilePath | None:
    """Analyse the bag as `adp analyze` does, print the numbers, and return the page if written."""
    from adp_path_follower.analysis.bag_analysis import metrics_table
    from adp_path_follower.analysis.costs import known_optimum
    from adp_path_follower.bags.reader import read_run
    from adp_path_follower.drawing.charts import ReferenceMotion
    from adp_path_follower.drawing.run_figures import draw_figures
    from adp_path_follower.study.replay.replay import replay, view_of_replay

    click.echo("analysing the bag and repeating the run")
    page = directory / "report.html"
    # Two processors share the work: the replay and the analysis do not need each other.
    with ProcessPoolExecutor(1, get_context("spawn")) as other:
        analysing = other.submit(_analyse, bag, name, page)
        run = read_run(bag)
        replayed = replay(run)
        first, follower = replayed.outputs[0], replayed.follower
        best = known_optimum(follower.settings, follower.path, float(first.arc_length), first.error)
        optimum = None
        if best is not None:
            optimum = ReferenceMotion(best.time, best.state[:, :3], best.modified_input)
        view = view_of_replay(run, replayed)
        draw_figures(view, directory / "figures", optimum)
        analysis = analysing.result()
    commands, identical = len(replayed.outputs), int(replayed.identical.sum())
    control_rate = (commands - 1) / float(view.time[-1]) if view.time[-1] > 0.0 else math.nan
    summary = {
        **analysis.metrics,
        "commands": commands,
        "identical_commands": identical,
        "control_rate": control_rate,
        "wall_time": wall_time,
        "real_time_factor": duration / wall_time,
    }
    outputs.write_json(directory / "summary.json", summary)
    click.echo(metrics_table([analysis]))
    for note in analysis.notes:
        click.echo(f"adp: {note}", err=True)
    click.echo(
        f"\nPathFollower repeats {identical} of {commands} commands exactly from the recorded "
        f"odometry, {control_rate:.1f} per simulated second.\n{duration:g} s of simulated time "
        f"took {wall_time:.0f} s. In {directory}: {', '.join(sorted(os.listdir(directory)))}"
    )
    return page if page.exists() else None


def _analyse(bag: FilePath, name: str, page: FilePath) -> BagAnalysis:
    """Analyse a bag, in a process of its own, and write its page if the libraries are there."""
    from adp_path_follower.analysis.bag_analysis import analyse_bag

    analysis = analyse_bag(bag, {}, 1, page.with_name("trajectory.tum"), title=name)
    try:
        require("report.html", "report")
    except AdpError as missing:
        click.echo(f"adp: {missing}", err=True)
        return analysis
    from adp_path_follower.analysis.bag_page import write_report

    write_report([analysis], [], page)
    return analysis
