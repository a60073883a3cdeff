"""`adp paper`: the paper reproduced."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

import click

from adp_path_follower.cli.options import FILE, new_directory, progress_bar, write_json


@click.command()
@click.option(
    "--out",
    "directory",
    type=FILE,
    metavar="DIR",
    help="Where figures and numbers go: a new or empty directory (adp_paper_DATE if it is not "
    "given).",
)
def paper(directory: Path | None) -> None:
    """Reproduce the paper's figures, and what they do not show.

    Simulates the paper's run with its printed laws and constants and each width of the sample
    grid, which the paper leaves open; finds the offline optimum; draws the paper's figures 2 to 5
    with the optimum's collocation points as circles, the same laws for ten minutes, and the
    quantities of its stability theorem. Needs no ROS; takes about a minute.
    """
    from adp_path_follower.paper import reproduce

    directory = new_directory(
        directory or Path(datetime.now().strftime("adp_paper_%Y_%m_%d-%H_%M_%S"))
    )
    with progress_bar("simulating and optimising") as progress:
        found = reproduce(progress)
    from adp_path_follower.analysis.paper_figures import draw_paper

    draw_paper(found, directory)
    theorem = found.theorem
    rows = [
        {
            "name": run.name,
            "cost": run.cost,
            "cost_ratio": run.cost / found.optimum.cost,
            "state_distance": run.state_distance,
            "input_distance": run.input_distance,
        }
        for run in found.runs
    ]
    labels = found.runs[0].settings.learning.value_basis.labels
    long_rows = [
        {
            "name": run.name,
            "cost": run.cost,
            "final_y": float(run.trajectories.error[0, -1, 1]),
            "final_actor_weights": run.trajectories.actor_weights[0, -1].tolist(),
        }
        for run in found.long_runs
    ]
    conditions = {
        "q_min": theorem.least_state_cost,
        "q_min_needed": theorem.cost_needed,
        "c_min": float(theorem.excitation.min()),
        "c_min_needed": theorem.excitation_needed,
        "residual_max": float(theorem.residual.max()),
        "drift_bound": theorem.drift_bound,
        "ideal_weights": theorem.ideal_weights.tolist(),
    }
    write_json(
        directory / "paper.json",
        {
            "optimal_cost": found.optimum.cost,
            "basis": list(labels),
            "runs": rows,
            "long_runs": long_rows,
            "theorem": conditions,
        },
    )
    click.echo(f"optimum J* = {found.optimum.cost:.6f}; 40 s from the paper's start:")
    click.echo(f"  {'':<30}{'J':>10}{'J/J*':>9}{'RMS e':>9}{'RMS u':>9}")
    for row, run in zip(rows, found.runs, strict=True):
        click.echo(
            f"  {run.name:<30}{run.cost:10.4f}{row['cost_ratio']:9.4f}"
            f"{run.state_distance:9.4f}{run.input_distance:9.4f}"
        )
    click.echo("after 600 s:")
    for run in found.long_runs:
        weights = run.trajectories.actor_weights[0, -1]
        lateral = ", ".join(f"{name} {weights[labels.index(name)]:+.3f}" for name in ("y θ", "y²"))
        final = run.trajectories.error[0, -1, 1]
        click.echo(f"  {run.name:<30}J {run.cost:8.3f}   y {final:+.3f} m   weights of {lateral}")
    click.echo("the theorem's sufficient conditions, with the printed constants:")
    for name in ("q_min", "c_min"):
        verdict = "holds" if conditions[name] > conditions[f"{name}_needed"] else "does not hold"
        click.echo(
            f"  {name} = {conditions[name]:.4g} > {conditions[f'{name}_needed']:.4g}: {verdict}"
        )
    click.echo(f"\nIn {directory}: the figures and paper.json")
