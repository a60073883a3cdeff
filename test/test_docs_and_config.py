"""Files and docs that are generated, or that state what the code does, agree with it."""

from __future__ import annotations

import json
import math
import pkgutil
import re
import runpy

import pytest
import yaml
from click.testing import CliRunner

from adp_path_follower import __version__
from adp_path_follower.cli.parameters import parameters
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings, parameter_file_text
from adp_path_follower.core.settings.schema import build, flatten, setting_fields
from adp_path_follower.drawing.figure_style import STYLE
from folders import ROOT
from sim_unicycle.settings import SimulatorSettings

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
TOP = "adp_path_follower|sim_unicycle|bench|examples|test|docs|config|launch"
GENERATED = ("bench/results/",)
PICTURES = sorted((ROOT / "docs" / "images").glob("*.*"))
CONFIGS = sorted((ROOT / "config").glob("*.yaml"))


def _anchors(text: str) -> set[str]:
    """Return the anchors of a page: named ones, and those of its headings."""
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    slugs = {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
    return {*re.findall(r'<a name="([^"]+)"></a>', text), *slugs}


def _without_head(text: str) -> str:
    """Return a parameter file without the comment above its first section."""
    return text[text.index("/**/path_follower:") :]


def test_the_parameter_table_is_the_generated_one():
    generated = CliRunner().invoke(parameters, ["--format", "markdown"]).output
    assert (ROOT / "docs" / "parameters.md").read_text(encoding="utf-8") == generated


def test_every_setting_is_in_the_table_and_explained():
    table = (ROOT / "docs" / "parameters.md").read_text(encoding="utf-8")
    for tree in (Settings, SimulatorSettings):
        for field in setting_fields(tree):
            assert re.search(rf"^- `{field.name}`.*: {re.escape(field.spec.doc)}$", table, re.M)
            assert field.spec.doc.endswith(".")


def test_default_yaml_holds_the_defaults():
    text = (ROOT / "config" / "default.yaml").read_text(encoding="utf-8")
    assert _without_head(text) == parameter_file_text(build(Settings, {}), "path_follower")


def test_default_yaml_ships_limits():
    limits = build(Settings, {}).limits
    assert (limits.min_linear_vel, limits.max_linear_vel) == (0.0, 1.0)
    assert limits.max_angular_vel == 1.5


def test_paper_yaml_holds_the_printed_constants():
    file = ROOT / "config" / "paper.yaml"
    settings = load_settings(Settings, "path_follower", file)
    assert _without_head(file.read_text(encoding="utf-8")) == parameter_file_text(
        settings, "path_follower"
    )
    printed = {
        "desired_speed": 0.5,
        "target_gain": 0.1,
        "path_state_gain": 0.05,
        "state_cost": (1.0, 1.0, 1.0),
        "input_cost": (1.0, 1.0),
        "critic_gain_measured": 0.5,
        "critic_gain_sampled": 10.0,
        "actor_gain": 5.0,
        "samples_per_axis": (3, 3, 3, 3),
        "initial_critic_weights": (0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.5, 0.0, 1.0),
        "initial_actor_weights": (0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.5, 0.0, 1.0),
        "basis": "paper",
        "frame": "serret_frenet",
        "scheduling": "path_state",
        "critic": "gradient",
        "wide_region": "none",
        "fallback": "none",
        "initial_weights": "listed",
        "min_linear_vel": -math.inf,
        "max_linear_vel": math.inf,
        "max_angular_vel": math.inf,
    }
    values = flatten(settings)
    assert {name: values[name] for name in printed} == printed


@pytest.mark.parametrize("file", CONFIGS, ids=lambda file: file.name)
def test_parameter_files_have_the_types_that_ros_wants(file):
    """ROS's parser keeps 1 an integer and refuses lists that mix integers and floats."""
    load_settings(Settings, "path_follower", file)
    (section,) = yaml.safe_load(file.read_text(encoding="utf-8")).values()
    kinds = {field.name: field for field in setting_fields(Settings)}
    for name, value in section["ros__parameters"].items():
        field = kinds[name]
        if field.item_kind is not None:
            assert {type(item) for item in value} == {field.item_kind}
        else:
            assert type(value) is field.kind


def test_versions_agree():
    package = (ROOT / "package.xml").read_text(encoding="utf-8")
    assert f"<version>{__version__}</version>" in package
    assert f"## {__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"\nversion: {__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_every_page_is_in_the_menu_of_the_site():
    menu = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    for page in (ROOT / "docs").glob("*.md"):
        assert f" {page.name}\n" in menu, f"docs/{page.name}: name it in mkdocs.yml"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        file, _, anchor = target.partition("#")
        linked = page.parent / file if file else page
        assert linked.exists(), target
        assert not anchor or anchor in _anchors(linked.read_text(encoding="utf-8")), target


@pytest.mark.parametrize("file", PICTURES, ids=[file.stem for file in PICTURES])
def test_text_in_pictures_can_be_read_on_a_phone(file):
    """Ten points at the style's dots an inch, shrunk to the 368 pixels of a page of 400."""
    head, dots = file.read_bytes()[:20], STYLE["figure.dpi"]
    width = int.from_bytes(head[16:20], "big")
    if head.startswith(b"GIF"):
        width, dots = int.from_bytes(head[6:8], "little"), 90  # bench/pictures/animation.py
    size = 10.0 / 72.0 * dots * min(1.0, 368.0 / width)
    assert size > 10.0


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_and_folders_that_the_docs_name_exist(page):
    text = page.read_text(encoding="utf-8")
    rooms = "|".join(file.name for file in (ROOT / "adp_path_follower").iterdir() if file.is_dir())
    for name in re.findall(rf"(?<![\w/.-])(?:{TOP}|{rooms})/[\w./-]*", text):
        found = name.rstrip(".")
        if not found.startswith(GENERATED):
            inside = (ROOT / found, ROOT / "adp_path_follower" / found)
            assert any(file.exists() for file in inside), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tests_and_modules_that_the_docs_name_exist(page):
    text = page.read_text(encoding="utf-8")
    files = [file for top in TOP.split("|") for file in (ROOT / top).rglob("*.py")]
    for name in re.findall(r"`(\w+\.py)`", text):
        assert any(file.name == name for file in files), name
    tests = " ".join(file.read_text(encoding="utf-8") for file in (ROOT / "test").rglob("*.py"))
    for name in re.findall(r"`(test_\w+)`", text):
        assert f"def {name}(" in tests, name
    for name in re.findall(r"`(adp_path_follower(?:\.\w+)+)(?:\(\))?`", text):
        assert pkgutil.resolve_name(name), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_targets_executables_and_extras_that_the_docs_name_exist(page):
    """`test_docs_commands.py` runs the commands; these need a network or ROS."""
    text = page.read_text(encoding="utf-8")
    makefile, setup = ((ROOT / name).read_text() for name in ("Makefile", "setup.py"))
    for target in re.findall(r"(?:`|^ *)make (\w+)", text, re.M):
        assert f"\n{target}:" in makefile, target
    for executable in re.findall(r"ros2 run adp_path_follower (\w+)", text):
        assert f'"{executable} = adp_path_follower.' in setup, executable
    for extra in re.findall(r"(?:adp_path_follower|'\.)\[(\w+)\]", text):
        assert f'"{extra}": ' in setup, extra


def test_pages_that_code_and_configuration_name_exist():
    for top in TOP.split("|"):
        for file in [*(ROOT / top).rglob("*.py"), *(ROOT / top).rglob("*.yaml")]:
            for page in re.findall(r"docs/\w+\.md", file.read_text(encoding="utf-8")):
                assert (ROOT / page).exists(), f"{file.relative_to(ROOT)}: {page}"


def test_the_bench_asks_the_tests_peer_for_what_it_has():
    """Such drives take too long to be tests, so a name that has gone would only show there."""
    peer = (ROOT / "test" / "support" / "live_nodes.py").read_text(encoding="utf-8")
    asked = set()
    for file in (ROOT / "bench").rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        if re.search(r"^from live_nodes import .*\bPeer\b", text, re.M):
            asked |= set(re.findall(r"\bpeer\.(\w+)", text))
    assert {"until", "call", "pause"} <= asked
    for name in sorted(asked):
        assert re.search(rf"def {name}\(self|self\.{name}(:.*)? = ", peer), name


def test_the_table_of_faults_is_that_of_the_bench_and_its_tests_exist():
    bench = runpy.run_path(str(ROOT / "bench" / "endurance" / "fault_table.py"))
    times = json.loads(bench["TIMES"].read_text(encoding="utf-8"))
    assert set(times) == set(bench["FAULTS"])
    page = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    assert page.count(bench["BEGIN"]) == page.count(bench["END"]) == 1
    assert page == bench["with_table"](page, times)
    tests = " ".join(file.read_text() for file in (ROOT / "test" / "ros").rglob("test_*.py"))
    for _, _, test in bench["FAULTS"].values():
        assert re.search(rf"def test_\w*{test}", tests), test


def test_the_numbers_of_the_method_are_those_of_adp_paper():
    bench = runpy.run_path(str(ROOT / "bench" / "site" / "numbers.py"))
    numbers = json.loads(bench["NUMBERS"].read_text(encoding="utf-8"))
    page = bench["PAGE"].read_text(encoding="utf-8")
    assert bench["with_numbers"](page, numbers) == page
    stale = page.replace("J* = 0.541887", "J* = 0.541888")
    assert bench["with_numbers"](stale, numbers) == page != stale


def test_notation_names_things_that_exist():
    """Every code name in docs/method.md is a setting, or stands in the core's source."""
    source = "".join(
        file.read_text(encoding="utf-8")
        for file in (*(ROOT / "adp_path_follower").rglob("*.py"), *ROOT.glob("sim_unicycle/*.py"))
    )
    page = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    notation = page[page.index("## Notation") : page.index("## Errata")]
    names = re.findall(r"`([^`]+)`", notation)
    assert len(names) > 30
    for name in names:
        assert re.search(rf"\b{re.escape(name.split('.')[-1].rstrip('()'))}\b", source), name


def test_messages_name_pages_that_there_are():
    """A pip installation has no folder docs/: messages say `adp docs PAGE` instead."""
    files = [
        file
        for folder in ("adp_path_follower", "sim_unicycle", "config", "launch")
        for file in (ROOT / folder).rglob("*")
        if file.suffix in (".py", ".yaml")
    ]
    pages = {file.stem for file in (ROOT / "docs").glob("*.md")}
    named = 0
    for file in files:
        text = file.read_text(encoding="utf-8")
        for page in re.findall(r"adp\s+docs\s+(\w+)", text):
            assert page in pages, f"{file.name}: adp docs {page}"
            named += 1
    assert named > 5


def test_the_command_prints_the_pages():
    from commands import adp

    listed = adp("docs")
    assert listed.stdout.split() == sorted(file.stem for file in (ROOT / "docs").glob("*.md"))
    page = adp("docs", "sweeps")
    assert page.stdout == (ROOT / "docs" / "sweeps.md").read_text(encoding="utf-8")
    refused = adp("docs", "sweep")
    assert refused.returncode == 2
    assert "unknown page 'sweep'; did you mean 'sweeps'?" in refused.stderr
