"""The page about a sweep: one file that opens without network."""

from __future__ import annotations

from pathlib import Path

from adp_path_follower.drawing.page import write_page
from adp_path_follower.sweeping.objectives import OBJECTIVES
from adp_path_follower.sweeping.optima import WHERE_KNOWN
from adp_path_follower.sweeping.overview import Overview, shown
from adp_path_follower.sweeping.sweep_figures import mapped, sweep_figures

_ROWS = 25


def write_sweep_page(found: Overview, title: str, file: Path) -> None:
    """Write the page about a sweep.

    Raises:
        FileError: It cannot be written.

    """
    sweep = found.sweep
    figures = sweep_figures(found)
    names = [item.name for item in sweep.variations]
    write_page(
        file,
        "sweep",
        {"figures": figures},
        title=title,
        found=found,
        sweep=sweep,
        names=names,
        objectives=[OBJECTIVES[name] for name in sweep.objectives],
        rows=[_row(found, names, int(number)) for number in found.ranked[:_ROWS]],
        front=[_row(found, names, int(number)) for number in found.front[:_ROWS]],
        captions=[(key, *_caption(key, figures[key], found)) for key in figures],
        number=shown,
        where_known=WHERE_KNOWN,
    )


def _row(found: Overview, names: list[str], number: int) -> list[str]:
    values = found.values(number)
    scores = [f"{found.scores[name][number]:.5g}" for name in found.sweep.objectives]
    return [*(shown(values[name]) for name in names), *scores]


def _caption(key: str, figure: dict, found: Overview) -> tuple[str, str]:
    first = found.sweep.objectives[0]
    if key == "pareto":
        second = found.sweep.objectives[1]
        return (
            "Pareto front",
            f"Every point is a combination of settings that is stable in all its runs: {first} "
            f"({OBJECTIVES[first].meaning}) against {second} ({OBJECTIVES[second].meaning}). On "
            "the front nothing is better in both.",
        )
    layout, measure = figure["layout"], mapped(found)
    across = str(layout["xaxis"]["title"]["text"])
    up = str(layout["yaxis"]["title"]["text"])
    if up == measure.name:
        return (f"{measure.name} over {across}", f"{measure.caption}: the median at each value.")
    return (
        f"{measure.name} over {across} and {up}",
        f"{measure.caption}: the median over everything else that varies; empty where there is "
        "none. Point at a field to read of how many.",
    )
