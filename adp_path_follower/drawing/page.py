"""A page of figures and tables: one file that opens without network."""

import hashlib
from pathlib import Path as FilePath
from typing import Any

from adp_path_follower import __version__
from adp_path_follower.core.files import write_output
from adp_path_follower.extras import require


def write_page(file: FilePath, name: str, data: dict[str, Any], **content: Any) -> None:
    """Write a page: NAME.html.j2 shows `content`, and NAME.js the figures in `data`.

    Raises AdpError if it cannot be written, or Plotly or Jinja2 is missing.
    """
    require("the page", "report")
    import jinja2
    from jinja2.utils import htmlsafe_json_dumps
    from markupsafe import Markup
    from plotly.io.json import to_json_plotly
    from plotly.offline import get_plotlyjs

    folder = FilePath(__file__).parent / "templates"
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(folder),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    # `<`, `>` and `&` are written as \u003c and so on: no string of the data can end the script.
    coded = htmlsafe_json_dumps(data, dumps=to_json_plotly)
    page = environment.get_template(f"{name}.html.j2").render(
        **content,
        version=__version__,
        # Only scripts that carry it run: one in the data's strings cannot know it.
        nonce=hashlib.sha256(coded.encode()).hexdigest()[:32],
        style=Markup((folder / "report.css").read_text(encoding="utf-8")),  # noqa: S704  # ours
        script=Markup((folder / f"{name}.js").read_text(encoding="utf-8")),  # noqa: S704  # ours
        plotly=Markup(get_plotlyjs()),  # noqa: S704  # the library itself
        data=coded,
    )
    write_output(file, page)
