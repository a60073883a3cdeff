"""A page of figures and tables: one file that opens without network."""

import base64
import datetime
import functools
import gzip
import hashlib
from pathlib import Path as FilePath
from typing import Any

from adp_path_follower import __version__
from adp_path_follower.core.files import write_output
from adp_path_follower.drawing.figure_style import ON_DARK
from adp_path_follower.extras import require


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


@functools.cache
def _library() -> str:
    """Return Plotly's own script, compressed."""
    from plotly.offline import get_plotlyjs

    return _packed(get_plotlyjs())


def _packed(text: str) -> str:
    """Return a text compressed, in letters that mean nothing in HTML."""
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode("ascii")
