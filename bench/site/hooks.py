"""Pages that mkdocs generates, and search without a server: mkdocs.yml names this file.

python bench/site/hooks.py writes docs/metrics.md, which is under version control.
"""

import json
import re
from pathlib import Path as FilePath
from typing import Any

import click

import adp_path_follower
from adp_path_follower.analysis.metrics import METRICS
from adp_path_follower.cli.main import adp

ROOT = FilePath(__file__).parents[2]
METRICS_PAGE = ROOT / "docs" / "metrics.md"

# Results of the functions, whose fields a script reads.
_RESULTS = (
    "study.simulation.simulate.SimulationResult",
    "study.comparison.compare.Comparison",
    "study.comparison.compare.Outcome",
    "study.optimum.collocation.Optimum",
    "analysis.bag_analysis.BagAnalysis",
)
# A page on file:// may start no worker from a file, but one from its own text.
_SEARCH_WORKER = """if (location.protocol === "file:") {
  const FileWorker = window.Worker;
  window.Worker = function () {
    return new FileWorker(URL.createObjectURL(new Blob([%s], {type: "text/javascript"})));
  };
}
"""


def metrics_page() -> str:
    """Return docs/metrics.md: the numbers of `adp analyze`."""
    lines = ["# Metrics", "", "The numbers of `adp analyze` and metrics.json. Generated from the"]
    lines += ["metrics in `adp_path_follower/analysis/metrics.py` by `make docs`.", ""]
    for metric in METRICS:
        unit = f" [{metric.unit}]" if metric.unit else ""
        lines.append(f"- `{metric.name}`{unit}: {metric.meaning}")
    return "\n".join(lines) + "\n"


def commands_page() -> str:
    """Return the page of all commands: what each says to --help."""
    lines = ["# Commands", "", "Each answers to `--help` with the same text.", ""]
    for name in ("", *adp.list_commands(click.Context(adp))):
        command = adp.get_command(click.Context(adp), name) if name else adp
        assert command is not None, name
        title = f"adp {name}".strip()
        context = click.Context(command, info_name=title, max_content_width=80, terminal_width=80)
        lines += [f"## {title}", "", "```text", command.get_help(context), "```", ""]
    return "\n".join(lines)


def python_page() -> str:
    """Return the page of the Python functions, which mkdocstrings fills from docstrings."""
    lines = ["# Python", "", "Everything is imported at its first use:", ""]
    lines += ["```python", "import adp_path_follower as adp", "```", ""]
    names = [f"{adp_path_follower.__name__}.{name}" for name in adp_path_follower.__all__]
    homes = [getattr(adp_path_follower, name).__module__ for name in adp_path_follower.__all__]
    lines += ["## Functions and classes", ""]
    for name, home in zip(names, homes, strict=True):
        lines += [f"::: {home}.{name.rpartition('.')[2]}", ""]
    lines += ["## Results", ""]
    for result in _RESULTS:
        lines += [f"::: {adp_path_follower.__name__}.{result}", ""]
    return "\n".join(lines)


def _from_the_root(name: str) -> str:
    """Return a page beside docs/ with its links as they are seen from docs/."""
    text = (ROOT / name).read_text(encoding="utf-8")
    for old, new in {"](docs/": "](", "](CHANGELOG.md": "](changelog.md"}.items():
        text = text.replace(old, new)
    return text


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are in no file of docs/."""
    from mkdocs.structure.files import File

    pages = {
        "commands.md": commands_page(),
        "python.md": python_page(),
        "contributing.md": _from_the_root("CONTRIBUTING.md"),
        "changelog.md": _from_the_root("CHANGELOG.md"),
    }
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_post_build(config: Any) -> None:
    """Write the script that lets the search work where no server is, and mend 404.html there.

    All pages are in one folder: links from there, not from a server's root, hold for a file, too.
    """
    site = FilePath(config.site_dir)
    lost = (site / "404.html").read_text(encoding="utf-8")
    lost = re.sub(r'((?:href|src)=|"(?:base|search)": |new URL\()"/', r'\1"./', lost)
    (site / "404.html").write_text(lost, encoding="utf-8")
    assets = site / "assets"
    (worker,) = (assets / "javascripts" / "workers").glob("search.*.min.js")
    source = worker.read_text(encoding="utf-8")
    text = _SEARCH_WORKER % json.dumps(source).replace("</", "<\\/")
    (assets / "iframe-worker.js").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    METRICS_PAGE.write_text(metrics_page(), encoding="utf-8")
