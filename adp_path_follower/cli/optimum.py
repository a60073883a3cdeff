"""`adp optimum`: the offline optimum."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from adp_path_follower.cli import options, outputs
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.resources import config_file
from sim_unicycle.fault_script import without_nodes
from sim_unicycle.settings import SimulatorSettings

if TYPE_CHECKING:  # with its solvers, for which `--help` need not wait
    from adp_path_follower.core.path.curve import Path
    from adp_path_follower.study.optimum.collocation import Optimum
    from adp_path_follower.study.optimum.problem import Motion

_DRAWN = ("s [m]", "y [m]", "θ [rad]", "v_e [m/s]", "ω_e [rad/s]")
_AGREEMENT = 1e-5  # relative difference between collocation and costates


@dataclass(frozen=True)
class _Row:
    """One start: what was found, or why nothing."""

    start: FloatArray
    optimum: Optimum | None
    check_cost: float | None
    problem: str


@click.command()
@options.settings_options
@options.simulator_options
@options.path_option
@options.start_options
@click.option("--horizon", type=float, default=30.0, show_default=True, help="Time [s].")
@click.option(
    "--check",
    is_flag=True,
    help="Solve each start a second time, by the costate boundary value problem.",
)
@outputs.json_option("Write costs and motions")
@options.file_option("--npz", "npz_file", "Write the motions.")
@options.file_option("--figure", "figure_file", "Draw the motions.", "FILE.png")
def optimum(
    params: FilePath | None,
    assignments: tuple[str, ...],
    simulator: SimulatorSettings,
    path_name: str,
    starts: tuple[tuple[float, float, float], ...],
    starts_file: FilePath | None,
    start_arc_length: float,
    horizon: float,
    check: bool,
    json_file: FilePath | None,
    npz_file: FilePath | None,
    figure_file: FilePath | None,
) -> None:
    r"""Find what the best controller would cost, by offline optimal control.

    Legendre-Gauss-Radau collocation on a graded mesh, solved by IPOPT from several starting
    guesses, among them the controller's own motion. Speed along the path, gains, cost and limits
    (but of jerk) are those of the parameters (the paper's, without limits, if none are given). How
    much J* changes with twice as many mesh intervals, and with a horizon half as long again, stands
    beside it.

    \b
    The paper's start:
        adp optimum --check
    With limits, before a sharp bend:
        adp optimum --params config/default.yaml --start 0.5 -0.5 1 \
            --start-arc-length 15

    With limits of acceleration, a lag or a ramp the robot starts from rest. A --robot is known with
    delay, lags, ramps, gains and bias; --check is for ideal ones without limits of acceleration.

    Exit code 1 if a start has no converged optimum, J* changes with the horizon by more than 1e-4
    of itself, or --check differs by more than 1e-5; it is named, the others are still written.
    """
    from adp_path_follower.study.optimum.collocation import OptimumSolver
    from adp_path_follower.study.optimum.costate import solve_costates
    from adp_path_follower.study.optimum.problem import OptimumError

    settings = load_settings(
        Settings, "path_follower", params or config_file("paper.yaml"), assignments
    )
    if check and len(settings.cost.input_cost) == 4 and not settings.limits.unlimited:
        raise AdpError("--check needs a diagonal input_cost where there are limits: leave it out")
    plant, _ = without_nodes(simulator)
    if check and (settings.motion.limited or not plant.model.ideal):
        raise AdpError("--check is for ideal robots without limits of acceleration: leave it out")
    path = named_path(path_name, settings.path)
    errors = options.collect_starts(starts, starts_file)
    outputs.check_writable(json_file, npz_file, figure_file)
    outputs.check_figure(figure_file)
    solver = OptimumSolver(settings, path, start_arc_length, horizon, plant)
    ways = _ways(settings, path, errors, start_arc_length, horizon)
    rows: list[_Row] = []
    with options.progress_bar(f"solving {len(errors)} starts") as progress:
        for index, start in enumerate(errors):
            found, check_cost, problem = None, None, ""
            try:
                found = solver.solve(start, ways[index])
                check_cost = solve_costates(solver.problem, found.motion).cost if check else None
                problem = _doubt(found, check_cost, start)
            except OptimumError as error:
                problem = str(error)
            rows.append(_Row(start, found, check_cost, problem))
            progress((index + 1) / len(errors))
    click.echo(_table(rows, check))
    problems = [row.problem for row in rows if row.problem]
    for text in problems:
        click.echo(f"adp: {text}", err=True)
    _write(rows, json_file, npz_file, figure_file)
    sys.exit(1 if problems else 0)


def _ways(
    settings: Settings, path: Path, errors: FloatArray, start_arc_length: float, horizon: float
) -> list[list[Motion]]:
    """Return the controller's own motion from each start (B, 3), as a guess for the optimum."""
    from adp_path_follower.core.control.far_from_path import missing_values, without_values
    from adp_path_follower.study.optimum.problem import motions_of
    from adp_path_follower.study.simulation.simulate import simulate

    known = np.asarray(np.isfinite(errors).all(axis=1))
    if not known.any():
        return [[] for _ in errors]
    found = simulate(
        without_values(settings) if missing_values(settings) else settings,
        path,
        errors[known],
        start_arc_length=start_arc_length,
        duration=horizon,
        rate=50.0,
        learning="frozen",
        record=True,
        record_weights=False,
    )
    return motions_of(found.trajectories, known)


def _doubt(found: Optimum, check_cost: float | None, start: FloatArray) -> str:
    """Return why an optimum is none: its horizon is too short, or the costates' cost differs."""
    subject = f"optimum from the start {start.tolist()}"
    if not found.settled:
        return (
            f"{subject} changes by {found.horizon_change:.1e} with a horizon half as long again: "
            "give a longer --horizon"
        )
    if check_cost is None or abs(check_cost - found.cost) <= _AGREEMENT * found.cost + 1e-9:
        return ""
    return (
        f"{subject} is {found.cost:.7g} by collocation, but {check_cost:.7g} by costates: one of "
        "the two is a local one, or not exact"
    )


def _write(
    rows: list[_Row],
    json_file: FilePath | None,
    npz_file: FilePath | None,
    figure_file: FilePath | None,
) -> None:
    if json_file is not None:
        outputs.write_json(json_file, {"optima": [_entry(row) for row in rows]})
    if npz_file is not None:
        outputs.write_npz(npz_file, _arrays(rows))
    if figure_file is not None:
        from adp_path_follower.drawing.figure_style import color
        from adp_path_follower.drawing.run_figures import draw_over_time

        curves = []
        for index, motion in enumerate([row.optimum.motion for row in rows if row.optimum]):
            values = np.column_stack([motion.state[:, :3], motion.modified_input])
            style = {"marker": "o", "markersize": 3, "linewidth": 1, "color": color(index)}
            curves.append((motion.time, values, style))
        title = "Offline optimum (points: collocation)"
        with outputs.whole_file(figure_file) as file:
            draw_over_time(file, title, _DRAWN, curves, until=15.0)  # [s]: later all is at rest


def _table(rows: list[_Row], check: bool) -> str:
    lines = [
        "   s [m]   y [m]  θ [rad]            J*   by mesh  by horizon  intervals"
        + ("   by costates" if check else "")
    ]
    notes = []
    for row in rows:
        head = "{:8.3f}{:8.3f}{:9.3f}".format(*row.start)
        if row.optimum is None:
            lines.append(f"{head}             –   no optimum found")
            continue
        found = row.optimum
        line = (
            f"{head}{found.cost:14.7f}{found.mesh_change:10.0e}{found.horizon_change:12.0e}"
            f"{found.intervals:11d}"
        )
        if row.check_cost is not None:
            line += f"{row.check_cost / found.cost - 1.0:+14.1e}"
        lines.append(line)
        if found.local_optima:
            notes.append(f"from {row.start.tolist()} {found.local_optima}")
    return "\n".join([*lines, *notes])


def _entry(row: _Row) -> dict[str, object]:
    if row.optimum is None:
        return {"start": row.start.tolist(), "converged": False, "problem": row.problem}
    found = row.optimum
    return {
        "start": row.start.tolist(),
        "converged": not row.problem,
        "problem": row.problem,
        "cost": found.cost,
        "mesh_change": found.mesh_change,
        "horizon_change": found.horizon_change,
        "costate_cost": row.check_cost,
        "guess_costs": list(found.guesses),
        "t": found.motion.time.tolist(),
        "e": found.motion.state[:, :3].tolist(),
        "s_p": found.motion.state[:, 3].tolist(),
        "u": found.motion.modified_input.tolist(),
    }


def _arrays(rows: list[_Row]) -> dict[str, Any]:
    """Return the motions: arrays with the number of the start behind their name."""
    arrays: dict[str, Any] = {"starts": np.array([row.start for row in rows])}
    for index, row in enumerate(rows):
        if row.optimum is not None:
            motion = row.optimum.motion
            arrays[f"cost_{index}"] = np.array(motion.cost)
            arrays[f"time_{index}"] = motion.time
            arrays[f"state_{index}"] = motion.state
            arrays[f"modified_input_{index}"] = motion.modified_input
    return arrays
