"""`adp simulate`: the closed loop without ROS."""

import sys
import time
from pathlib import Path as FilePath

import click
import numpy as np

from adp_path_follower.cli import options, outputs
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.errors import FileError, PathError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.weights_file import read_weights
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import named_route
from adp_path_follower.core.path.route import Route
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.criteria import SETTLED
from adp_path_follower.drawing.page import Card, Table, write_runs_page
from adp_path_follower.extras import require
from adp_path_follower.study.simulation.route import is_plain, simulate_route
from adp_path_follower.study.simulation.simulate import (
    LEARNING_MODES,
    ControllerFactory,
    SimulationResult,
)
from adp_path_follower.study.simulation.simulate import simulate as run_simulation
from sim_unicycle.fault_script import without_nodes
from sim_unicycle.settings import PlantSettings, SimulatorSettings

_ROWS_SHOWN = 20
_RUNS_DRAWN = 6  # on the page, as there are colours


@click.command()
@options.settings_options
@options.simulator_options
@options.path_option
@options.start_options
@click.option("--duration", type=float, default=30.0, show_default=True, help="Time [s].")
@click.option("--rate", type=float, default=100.0, show_default=True, help="Control rate [Hz].")
@click.option(
    "--learning",
    type=click.Choice(LEARNING_MODES),
    default="cold",
    show_default=True,
    help="cold: the parameters' weights at t = 0; warm: learned at the start until they settle "
    "before the clock runs; frozen: never changed.",
)
@options.file_option(
    "--weights", "weights_file", "Start from weights that ~/save_weights of the controller wrote."
)
@outputs.json_option("Write the outcome of each run")
@click.option(
    "--allow-failures", is_flag=True, help="Exit with 0 although a run left the path, not 1."
)
@options.file_option("--npz", "npz_file", "Write the trajectories.")
@options.file_option("--report", "page", "Write a page with the first six runs.")
def simulate(
    params: FilePath | None,
    assignments: tuple[str, ...],
    simulator: SimulatorSettings,
    path_name: str,
    starts: tuple[tuple[float, float, float], ...],
    starts_file: FilePath | None,
    start_arc_length: float,
    duration: float,
    rate: float,
    learning: str,
    weights_file: FilePath | None,
    json_file: FilePath | None,
    npz_file: FilePath | None,
    page: FilePath | None,
    allow_failures: bool,
) -> None:
    r"""Simulate the closed loop without ROS, from one or many starts.

    The cost J is integrated along the true motion of the robot. Exit code 1 if a run left the path.

    \b
    The paper's run:
        adp simulate --params config/paper.yaml --duration 40
    Its initial weights, without learning:
        adp simulate --params config/paper.yaml --duration 40 --learning frozen
    A thousand starts, all at once:
        adp simulate --starts starts.csv --json runs.json
    A robot with 50 ms delay, and a push:
        adp simulate --sim-set command_delay=0.05 --sim-set fault_script=push
    """
    settings = load_settings(Settings, "path_follower", params, assignments)
    plant, faults = without_nodes(simulator)
    route = named_route(path_name, settings.path)
    errors = options.collect_starts(starts, starts_file)
    if not is_plain(route):
        plain = weights_file is None and npz_file is page is None and learning != "warm"
        if not plain or start_arc_length or faults.entries:
            raise PathError(
                f"path '{path_name}' has turns on the spot or is driven backwards: leave out "
                "--weights, --npz, --report, --start-arc-length, fault_script and --learning warm"
            )
        _simulate_route(settings, route, errors, duration, rate, learning, plant, json_file)
        return
    path = route.segments[0].path
    outputs.check_writable(json_file, npz_file, page)
    if page is not None:
        require("adp simulate --report", "report")
    make_controller: ControllerFactory = PathFollower
    if weights_file is not None:
        make_controller = _starting_from(weights_file, settings)
    begun = time.perf_counter()
    with options.progress_bar(f"simulating {len(errors)} runs of {duration:g} s") as progress:
        result = run_simulation(
            settings,
            path,
            errors,
            start_arc_length=start_arc_length,
            duration=duration,
            rate=rate,
            learning=learning,
            controller=make_controller,
            plant=plant,
            faults=faults,
            record=npz_file is not None or page is not None,
            progress=progress,
        )
    elapsed = time.perf_counter() - begun
    click.echo(_table(result))
    simulated = len(errors) * duration
    speed = f"{simulated / elapsed:.0f} simulated seconds per second"
    click.echo(f"simulated {simulated:g} s in {elapsed:.1f} s: {speed}", err=True)
    if json_file is not None:
        outputs.write_json(json_file, {"runs": _runs(result)})
    if npz_file is not None and result.trajectories is not None:
        outputs.write_npz(npz_file, {"starts": result.starts, **vars(result.trajectories)})
    if page is not None:
        _write_page(result, path, settings, simulator, path_name, page)
    failed = int(result.failed.sum())
    if failed and not allow_failures:
        click.echo(f"adp: {failed} of {len(errors)} runs left the path", err=True)
        sys.exit(1)


def _write_page(
    result: SimulationResult,
    path: Path,
    settings: Settings,
    simulator: SimulatorSettings,
    path_name: str,
    file: FilePath,
) -> None:
    """Write the page of the first runs, and say where it is."""
    from adp_path_follower.study.simulation.shown import shown_run  # a third of the start-up

    count, trajectories = min(len(result.starts), _RUNS_DRAWN), result.trajectories
    assert trajectories is not None  # recorded for it
    names = [f"from ({s:.3g}, {y:.3g}, {theta:.3g})" for s, y, theta in result.starts[:count]]
    faults = without_nodes(simulator)[1]
    runs = [
        shown_run(name, path, settings, trajectories, run, count, faults)
        for run, name in enumerate(names)
    ]
    ends = np.linalg.norm(result.final_error[:count], axis=1)
    columns = ("start (s, y, θ)", "J", "settled in [s]", "|e| at the end")
    numbers = zip(result.cost, result.settling_time, ends, strict=False)

    def cell(value: float, otherwise: str = "–") -> tuple[str, float]:
        return f"{value:.6g}" if np.isfinite(value) else otherwise, float(value)

    rows = tuple(
        ((name, np.nan), cell(cost), cell(time), cell(end, "left the path"))
        for name, (cost, time, end) in zip(names, numbers, strict=False)
    )
    about = "The virtual target begins at the same place for every run; θ is in radians."
    if count < len(result.starts):
        about += f" The first {count} of {len(result.starts)} runs are drawn."
    title = f"Simulated run{'s' * (count > 1)} on {path_name}"
    table = Table(columns, rows)
    given: list[object] = [settings, simulator]
    write_runs_page(file, title, about, "adp simulate", given, _cards(result), runs, table)
    click.echo(file.resolve().as_uri())


def _cards(result: SimulationResult) -> tuple[Card, ...]:
    """Return what the page of the runs shows first."""
    count, failed = len(result.starts), int(result.failed.sum())
    sound, settled = ~result.failed, result.settling_time[np.isfinite(result.settling_time)]
    costs, ends = result.cost[sound], np.linalg.norm(result.final_error[sound], axis=1)
    median = f"{np.median(costs):.6g}" if len(costs) else "–"
    slowest = f"{settled.max():.2f} s" if len(settled) else "–"
    several = count > 1
    of_costs = f", median of {len(costs)} of {count} runs" * several
    of_times = f", the slowest of {len(settled)} of {count} runs" * several
    end = f"{ends.max():.2g}" if len(ends) else "–"
    return (
        ("cost J", median, f"∫ eᵀQe + uᵀRu{of_costs}"),
        ("settled after", slowest, f"|e| below {SETTLED:g} from then{of_times}"),
        ("error at the end", end, "|e|" + ", the largest" * several),
        ("left the path", f"{failed} of {count}", "runs that went too far away from it"),
    )


def _simulate_route(
    settings: Settings,
    route: Route,
    starts: FloatArray,
    duration: float,
    rate: float,
    learning: str,
    plant: PlantSettings,
    json_file: FilePath | None,
) -> None:
    outputs.check_writable(json_file)
    learns = settings.learning.learning and learning != "frozen"
    settings = settings.with_changes(learning=learns, path_start="beginning")
    with options.progress_bar(f"simulating {len(starts)} runs of {duration:g} s") as progress:
        runs = simulate_route(settings, route, starts, duration, rate, plant, progress)
    click.echo("   s [m]   y [m]  θ [rad]        cost J  goal [s]  backwards [s]   ends at")
    for run in runs:
        (s, y, theta), end = run.start, ", ".join(f"{value:.3f}" for value in run.final_pose)
        goal = f"{run.goal_time:8.2f}" if np.isfinite(run.goal_time) else "       –"
        times = f"{goal}  {run.reversed_for:13.2f}"
        click.echo(f"{s:8.3f} {y:7.3f} {theta:8.3f} {run.cost:13.6f}  {times}   ({end})")
    if json_file is not None:
        outputs.write_json(json_file, {"runs": [vars(run) for run in runs]})


def _starting_from(file: FilePath, settings: Settings) -> ControllerFactory:
    """Return a maker of followers that start from a weights file; FileError if they cannot."""
    saved, _ = read_weights(file, settings)

    def make(settings: Settings, path: Path, arc_length: FloatArray) -> PathFollower:
        follower = PathFollower(settings, path, arc_length)
        problem = follower.start_from(saved)
        if problem:
            raise FileError(f"weights file {file} does not hold for this path: {problem}")
        return follower

    return make


def _runs(result: SimulationResult) -> list[dict[str, object]]:
    columns = {
        "start": result.starts,
        "cost": result.cost,
        "final_error": result.final_error,
        "settled": np.isfinite(result.settling_time),
        "settling_time": result.settling_time,
        "max_inputs": result.max_inputs,
        "critic_weights": result.weights.critic,
        "actor_weights": result.weights.actor,
        "excitation": result.excitation,
        "failed": result.failed,
    }
    runs = range(len(result.starts))
    return [{name: values[run] for name, values in columns.items()} for run in runs]


def _table(result: SimulationResult) -> str:
    """Return the runs as a table, and what they have in common."""
    count = len(result.starts)
    lines = ["   s [m]   y [m]  θ [rad]        cost J  settled [s]   |e| at the end"]
    for run in range(min(count, _ROWS_SHOWN)):
        s, y, theta = result.starts[run]
        settled = result.settling_time[run]
        settled_text = f"{settled:11.2f}" if np.isfinite(settled) else "          –"
        end = np.linalg.norm(result.final_error[run])
        end_text = "left the path" if result.failed[run] else f"{end:.3e}"
        lines.append(
            f"{s:8.3f} {y:7.3f} {theta:8.3f} {result.cost[run]:13.6f}  {settled_text}   {end_text}"
        )
    if count > _ROWS_SHOWN:
        lines.append(f"… and {count - _ROWS_SHOWN} more")
    if count > 1:
        sound = result.cost[~result.failed]
        summary = "none finished"
        if len(sound):
            median, high = np.quantile(sound, [0.5, 0.95])
            summary = f"median {median:.6f}, 95 % {high:.6f}, maximum {sound.max():.6f}"
        settled_count = int(np.isfinite(result.settling_time).sum())
        lines.append(
            f"cost J: {summary}; {settled_count} of {count} settled to |e| < {SETTLED:g}, "
            f"{int(result.failed.sum())} failed"
        )
    return "\n".join(lines)
