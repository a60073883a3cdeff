"""`adp paper`: the paper reproduced."""

from __future__ import annotations

import logging
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import click

from adp_path_follower.cli import options, outputs

if TYPE_CHECKING:  # it needs CasADi, which `--help` does not
    from adp_path_follower.study.paper import Reproduction

log = logging.getLogger(__name__)


@click.command()
@options.out_option("paper", "figures and numbers")
def paper(directory: FilePath) -> None:
    """Reproduce the paper's figures, and what they do not show.

    Simulates the paper's run with its printed laws and constants and each width of the sample
    grid, which the paper leaves open; finds the offline optimum; draws the paper's figures 2 to 5
    with the optimum as circles, the same laws for ten minutes, and the quantities of its stability
    theorem. Needs no ROS; takes some minutes.
    """
    from adp_path_follower.study.paper import reproduce

    with outputs.output_directory(directory):
        log.info("simulating the paper's run, ten minutes of it, and 26 optima: some minutes")
        with options.progress_bar("simulating and optimising") as progress:
            found = reproduce(progress)
        from adp_path_follower.study.paper import draw_paper

        draw_paper(found, directory)
        numbers = _numbers(found)
        outputs.write_json(directory / "paper.json", numbers)
    click.echo(_text(numbers))
    click.echo(f"\nIn {directory}: the figures and paper.json")


def _numbers(found: Reproduction) -> dict[str, Any]:
    theorem = found.theorem
    return {
        "optimal_cost": found.optimum.cost,
        "basis": list(found.shipped.settings.learning.value_basis.labels),
        "runs": [
            {
                "name": run.name,
                "cost": run.cost,
                "cost_ratio": run.cost / found.optimum.cost,
                "state_distance": run.state_distance,
                "input_distance": run.input_distance,
            }
            for run in found.runs
        ],
        "long_runs": [
            {
                "name": run.name,
                "cost": run.cost,
                "final_y": float(run.trajectories.error[0, -1, 1]),
                "final_actor_weights": run.trajectories.actor_weights[0, -1].tolist(),
            }
            for run in found.long_runs
        ],
        "theorem": {
            "q_min": theorem.least_state_cost,
            "q_min_needed": theorem.cost_needed,
            "c_min": float(theorem.excitation.min()),
            "c_min_needed": theorem.excitation_needed,
            "residual_max": float(theorem.residual.max()),
            "drift_bound": theorem.drift_bound,
            "ideal_weights": theorem.ideal_weights.tolist(),
        },
    }


def _text(numbers: dict[str, Any]) -> str:
    lines = [
        f"optimum J* = {numbers['optimal_cost']:.6f}; 40 s from the paper's start:",
        f"  {'':<30}{'J':>10}{'J/J*':>9}{'RMS e':>9}{'RMS u':>9}",
    ]
    lines += [
        f"  {run['name']:<30}{run['cost']:10.4f}{run['cost_ratio']:9.4f}"
        f"{run['state_distance']:9.4f}{run['input_distance']:9.4f}"
        for run in numbers["runs"]
    ]
    lines.append("after 600 s:")
    for run in numbers["long_runs"]:
        weights = dict(zip(numbers["basis"], run["final_actor_weights"], strict=True))
        lateral = ", ".join(f"{name} {weights[name]:+.3f}" for name in ("y θ", "y²"))
        lines.append(
            f"  {run['name']:<30}J {run['cost']:8.3f}   y {run['final_y']:+.3f} m   "
            f"weights of {lateral}"
        )
    lines.append("the theorem's sufficient conditions, with the printed constants:")
    for name in ("q_min", "c_min"):
        value, needed = numbers["theorem"][name], numbers["theorem"][f"{name}_needed"]
        verdict = "holds" if value > needed else "does not hold"
        lines.append(f"  {name} = {value:.4g} > {needed:.4g}: {verdict}")
    return "\n".join(lines)
