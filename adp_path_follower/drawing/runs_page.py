"""The page of runs that start together on one map."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath

from adp_path_follower.drawing.charts import ShownRun
from adp_path_follower.drawing.figure_style import color
from adp_path_follower.drawing.page import write_page
from adp_path_follower.drawing.page_figures import distance_scales, motions, page_figures


@dataclass(frozen=True)
class Table:
    """A table that the reader can sort."""

    columns: tuple[str, ...]  # the first names a run
    rows: tuple[tuple[tuple[str, float], ...], ...]  # text and number of each cell but the first


def write_runs_page(
    file: FilePath, title: str, about: str, maker: str, runs: Sequence[ShownRun], table: Table
) -> None:
    """Write the page of runs that start together; raise AdpError if it cannot be written."""
    several = len(runs) > 1
    arrows = "Every arrow is a robot" if several else "The arrow is the robot"
    captions = (
        (
            *("track", "The race" if several else "The drive"),
            f"{arrows} at the time of the slider below.",
        ),
        ("distance", "Distance from the path", "Positive to the left of the path."),
        ("cost", "Cost so far", "∫ eᵀQe + uᵀRu from the start: the lowest curve is the best."),
        ("commands", "Commands", "Each holds until the next; dashed lines are limits."),
    )
    write_page(
        file,
        "runs",
        {"figures": page_figures(runs), "motions": motions(runs), "scales": distance_scales()},
        title=title,
        about=about,
        maker=maker,
        names=[(run.name, color(index)) for index, run in enumerate(runs)],
        captions=captions,
        table=table,
    )
