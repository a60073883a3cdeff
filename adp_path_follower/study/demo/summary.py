"""The summary of a run in words."""

from __future__ import annotations

import math
from pathlib import Path as FilePath

from adp_path_follower.study.demo.metrics import RunMetrics
from adp_path_follower.study.optimum.reference import COST_HORIZON

_CAPTIONS = {
    "figure_2_path.png": "The path, the robot's track and the virtual target. The robot starts "
    "0.5 m behind the target and 0.25 m to its left, heading 30° to the right.",
    "figure_3_states.png": "The errors to the virtual target: s along the path, y across it, θ "
    "in heading. Circles mark the offline optimum from the same start, where it is known.",
    "figure_4_controls.png": "The inputs that the learned policy adds to the feedforward "
    "v_ss = v_des, ω_ss = κ v_des, and those of the optimum.",
    "figure_5_weights.png": "The weights of the value function (critic) and of the policy "
    "(actor), which are learned while driving. They move from the initial guess to what makes the "
    "Bellman errors at the sampled states smallest; with scheduling: arc_length they also change "
    "from place to place, before and in a bend.",
}


def summary_rows(metrics: RunMetrics) -> list[tuple[str, str, str]]:
    """Return name, value and explanation of each number."""

    def number(value: float, form: str, unit: str = "") -> str:
        return f"{value:{form}}{unit}" if math.isfinite(value) else "–"

    same = f"{metrics.identical_commands} of {metrics.commands}"
    return [
        (
            f"cost J over {COST_HORIZON:g} s",
            number(metrics.cost, ".6f"),
            "∫ eᵀQe + uᵀRu along the robot's motion",
        ),
        (
            "J / J*",
            number(metrics.cost_ratio, ".4f"),
            f"to the offline optimum {number(metrics.optimal_cost, '.6f')} from this start",
        ),
        (
            "cross-track error, RMS",
            number(1000.0 * metrics.cross_track_rms, ".2f", " mm"),
            "sideways, after 10 s",
        ),
        (
            "cross-track error, maximum",
            number(1000.0 * metrics.cross_track_max, ".2f", " mm"),
            "sideways, after 10 s",
        ),
        (
            "settling time",
            number(metrics.settling_time, ".2f", " s"),
            "until |e| stays below 2 % of its start",
        ),
        (
            "learning certificate",
            number(metrics.excitation_min, ".4f"),
            "smallest singular value of the rank condition; above 0, every weight is determined",
        ),
        (
            "control rate",
            number(metrics.control_rate, ".1f", " Hz"),
            "commands per simulated second",
        ),
        ("commands repeated exactly", same, "by PathFollower fed with the recorded odometry"),
        ("messages recorded", str(metrics.messages), "in the bag"),
    ]


def summary_table(metrics: RunMetrics) -> str:
    """Return the summary for a terminal."""
    rows = summary_rows(metrics)
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    return "\n".join(
        f"  {name:<{widths[0]}}  {value:>{widths[1]}}   {meaning}" for name, value, meaning in rows
    )


def summary_markdown(metrics: RunMetrics, figures: list[FilePath]) -> str:
    """Return the report of a run, with its figures."""
    # A bar would end the table's cell.
    rows = [[cell.replace("|", "\\|") for cell in row] for row in summary_rows(metrics)]
    lines = [
        "# What you saw",
        "",
        "A unicycle robot followed a path. The controller started with a first guess of the value "
        "function of an optimal control problem, learned a better one while driving, and steered "
        "by the policy that follows from it.",
        "",
        "| | | |",
        "|---|---|---|",
        *(f"| {name} | {value} | {meaning} |" for name, value, meaning in rows),
    ]
    for figure in figures:
        lines += ["", f"![{figure.stem}]({figure.as_posix()})", "", _CAPTIONS[figure.name]]
    lines += [
        "",
        "Look at the run itself with `bag/` in RViz (`ros2 bag play`), Foxglove or PlotJuggler.",
    ]
    return "\n".join(lines) + "\n"
