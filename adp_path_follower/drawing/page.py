"""A page of figures and tables: one file that opens without network."""

import base64
import datetime
import functools
import gzip
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

from adp_path_follower import __version__
from adp_path_follower.core.files import write_output
from adp_path_follower.core.settings.schema import build, flatten, yaml_text
from adp_path_follower.drawing.charts import ShownRun
from adp_path_follower.drawing.figure_style import ON_DARK, color
from adp_path_follower.extras import require


@dataclass(frozen=True)
class Table:
    """A table that the reader can sort."""

    columns: tuple[str, ...]  # the first names a run
    rows: tuple[tuple[tuple[str, float], ...], ...]  # text and number of each cell but the first


Card = tuple[str, str, str]  # label, number and detail of what is seen first


def write_page(file: FilePath, name: str, data: dict[str, Any], **content: Any) -> None:
    """Write a page: NAME.html.j2 shows `content`, and page.js the figures in `data`.

    Library and data are compressed, which the browser undoes: the page is a third as large.
    Raises AdpError if it cannot be written, or Plotly or Jinja2 is missing.
    """
    require("the page", "report")
    import jinja2
    from markupsafe import Markup
    from plotly.io.json import to_json_plotly

    folder = FilePath(__file__).parent / "templates"
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    for figure in data["figures"].values():
        figure["layout"].pop("template", None)  # the page has its own colours
    coded = _packed(to_json_plotly(data | {"on_dark": ON_DARK}))
    page = environment.get_template(f"{name}.html.j2").render(
        **content,
        plays=bool(data.get("motions")),
        version=__version__,
        made=datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M"),
        # Only scripts that carry it run: one in the data's strings cannot know it.
        nonce=hashlib.sha256(coded.encode()).hexdigest()[:32],
        style=Markup((folder / "page.css").read_text(encoding="utf-8")),  # noqa: S704  # ours
        script=Markup((folder / "page.js").read_text(encoding="utf-8")),  # noqa: S704  # ours
        library=_library(),
        data=coded,
    )
    write_output(file, page)


def write_runs_page(
    file: FilePath,
    title: str,
    about: str,
    maker: str,
    settings: Sequence[object],
    cards: Sequence[Card],
    runs: Sequence[ShownRun],
    table: Table,
) -> None:
    """Write the page of runs that start together, with all settings that are not the defaults.

    Raises AdpError if it cannot be written.
    """
    require("the page", "report")
    from adp_path_follower.drawing.page_figures import page_data

    several = len(runs) > 1
    disturbed = any(run.charts.halts for run in runs)
    panels = [panel for run in runs for panel in run.charts.panels.get("commands", ())]
    limited = any(math.isfinite(limit) for panel in panels for limit in panel.limits)
    arrows = "Every arrow is a robot" if several else "The arrow is the robot"
    captions = (
        (
            *("track", "The race" if several else "The drive"),
            f"{arrows} at the time of the slider below, which “follow” keeps in sight.",
        ),
        (
            *("distance", "Distance from the path"),
            "Positive to the left of the path." + " The fault script acts in grey." * disturbed,
        ),
        ("cost", "Cost so far", "∫ eᵀQe + uᵀRu from the start."),
        ("commands", "Commands", "Each holds until the next" + "; dashed: limits" * limited + "."),
    )
    write_page(
        file,
        "runs",
        page_data(runs),
        title=title,
        about=about,
        settings=[text for group in settings for text in _changed(group)],
        maker=maker,
        headline=cards,
        names=[(run.name, color(index)) for index, run in enumerate(runs)],
        captions=captions,
        table=table,
    )


@functools.cache
def _library() -> str:
    """Return Plotly's own script, compressed."""
    from plotly.offline import get_plotlyjs

    return _packed(get_plotlyjs())


def _changed(settings: object) -> list[str]:
    """Return name and value of the settings that are not the defaults."""
    usual = flatten(build(type(settings), {}))
    values = flatten(settings).items()
    return [f"{name} {yaml_text(value)}" for name, value in values if value != usual[name]]


def _packed(text: str) -> str:
    """Return a text compressed, in letters that mean nothing in HTML."""
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode("ascii")
