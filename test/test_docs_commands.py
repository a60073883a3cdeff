"""Every command in README and docs is run, or a reason says why not; then its options are read."""

import inspect
import re
import shlex
import textwrap
from dataclasses import dataclass

import click
import pytest
import yaml
from robots import TYPICAL

import adp_path_follower as package
from adp_path_follower.cli.main import adp as adp_group
from bag_messages import drive_on_line, write_bag
from commands import adp
from driven_robots import driven, slalom
from folders import ROOT
from torn_bags import write_run

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
SHELL = ("sh", "bash", "console")
# Beginning of a command -> why it is not run here.
NOT_RUN = {
    "adp compare": "takes minutes: test/study/comparison runs it",
    "adp demo": "drives real nodes: test/study/test_demo.py runs it",
    "adp paper": "takes minutes: test/study/test_paper.py runs it",
    "adp sweep": "takes minutes: test/cli/test_sweep.py runs one",
    "adp tune": "takes minutes: test/study/sweeps runs one",
    "cd ": "needs a workspace and a network: .ci/colcon does it",
    "colcon ": "needs a workspace: .ci/colcon does it",
    "OMP_NUM_THREADS=1 dask ": "needs several machines",
    "dask ": "needs several machines",
    "do": "needs ROS's command line",
    "for node": "needs ROS's command line",
    "git ": "needs a network",
    "make": "makes an environment, or takes minutes",
    "python bench/": "takes minutes",
    "ros2 ": "needs ROS's command line",
    "rosdep ": "needs ROS and a network",
    "source ": "needs a workspace",
}
# Command -> arguments that shorten it: the last value of an option counts.
SHORTER = {
    "optimum": ["--path", "line"],
    "simulate": ["--duration", "0.3", "--set", "wide_region=approach"],
}


@dataclass(frozen=True)
class Documented:
    """One command of a page."""

    page: str
    text: str

    @property
    def reason(self):
        """Return why it is not run; empty if it is."""
        return next((why for key, why in NOT_RUN.items() if self.text.startswith(key)), "")


def blocks(page, kinds):
    """Return the contents of a page's fenced blocks of these kinds."""
    text = page.read_text(encoding="utf-8")
    found = re.findall(r"^( *)```(\w*)\n(.*?)^\1```$", text, re.M | re.S)
    return [textwrap.dedent(content) for _, kind, content in found if kind in kinds]


def commands_of(page):
    """Return the commands of a page's shell blocks, one by one, without comments."""
    lines = []
    for block in blocks(page, SHELL):
        whole = block.replace("\\\n", " ").splitlines()
        if any(line.startswith("$ ") for line in whole):  # the others are output
            whole = [line.removeprefix("$ ") for line in whole if line.startswith("$ ")]
        lines += [part for line in whole for part in re.split(r"&&|;", re.sub(r"\s#.*", "", line))]
    return [Documented(page.stem, " ".join(line.split())) for line in lines if line.strip()]


COMMANDS = [command for page in PAGES for command in commands_of(page)]
RUN = list({command.text: command for command in COMMANDS if not command.reason}.values())
INLINE = [
    Documented(page.stem, " ".join(text.split()))
    for page in PAGES
    for text in re.findall(r"`(adp [a-z][^`]*)`", page.read_text(encoding="utf-8"))
]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return a folder with the repository's files, and those that a reader has by then."""
    folder = tmp_path_factory.mktemp("reader")
    for name in ("config", "examples", "bench", "docs"):
        (folder / name).symlink_to(ROOT / name)
    for name in ("my_bag", "my_run"):
        write_run(folder / name)
    messages = drive_on_line(lambda time: 0.01)
    write_bag(
        folder / "nav2_run",
        [("/plan" if topic == "/path" else topic, *rest) for topic, *rest in messages],
    )
    write_bag(folder / "my_drive", driven(TYPICAL, slalom, duration=10.0))
    (folder / "my_robot.yaml").symlink_to(ROOT / "config" / "default.yaml")
    (folder / "my_path.csv").write_text("x,y\n0,0\n3,0\n6,1\n9,1\n")
    return folder


@pytest.mark.parametrize("command", RUN, ids=lambda command: f"{command.page}: {command.text}")
def test_the_command_works(command, files, tmp_path, monkeypatch):
    for file in files.iterdir():
        (tmp_path / file.name).symlink_to(file)
    text, _, output = command.text.partition(" > ")
    name, *words = shlex.split(text.replace("$PWD", str(tmp_path)))
    if name == "export":
        assert words == [f"ADP_PLUGINS={tmp_path}/examples/own_basis.py"]  # set below
        return
    assert name == "adp", f"run {command.text}, or say in NOT_RUN why not"
    for word in SHORTER.keys() & set(words):
        words += SHORTER[word]
    monkeypatch.setenv("ADP_PLUGINS", str(ROOT / "examples" / "own_basis.py"))
    done = adp(*words, cwd=tmp_path)
    unmet = "--require" in words  # the bag tells nothing of faults: that keeps no limit
    assert done.returncode == int(unmet), done.stderr
    assert done.stdout or done.stderr
    assert not output or "ros__parameters" in done.stdout


@pytest.mark.parametrize(
    "command",
    [item for item in (*COMMANDS, *INLINE) if re.match(r"adp [-a-z]", item.text)],
    ids=lambda command: f"{command.page}: {command.text}",
)
def test_the_command_has_its_options(command):
    words = shlex.split(command.text.partition(" > ")[0].replace("…", ""))[1:]
    context = click.Context(adp_group)
    _, words, _ = adp_group.make_parser(context).parse_args(words)
    name, *words = words
    found = adp_group.get_command(context, name)
    assert found is not None, name
    valued = {
        name for item in found.params if not getattr(item, "is_flag", 0) for name in item.opts
    }
    if command in INLINE and valued & {*words[-1:]}:  # prose names an option without its value
        words = [*words, "VALUE"]
    found.make_parser(click.Context(found)).parse_args(words)


def test_every_reason_is_needed_and_no_command_hides_in_an_indented_block():
    for beginning in NOT_RUN:
        assert any(command.text.startswith(beginning) for command in COMMANDS), beginning
    for page in PAGES:
        text = re.sub(
            r"^( *)```\w*\n.*?^\1```$", "", page.read_text(encoding="utf-8"), flags=re.M | re.S
        )
        assert re.findall(r"^    (?:\$ )?(?:adp|ros2|make|python|dask) .*", text, re.M) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_of_the_page_runs_and_its_yaml_can_be_read(page, capsys, monkeypatch):
    """The seconds are fewer, and a comparison takes half a minute: its arguments are read."""
    simulate, signature = package.simulate, inspect.signature(package.compare)
    monkeypatch.setattr(
        package, "simulate", lambda *given, **named: simulate(*given, **named | {"duration": 0.3})
    )
    monkeypatch.setattr(package, "compare", signature.bind)
    for block in blocks(page, ("yaml",)):
        assert isinstance(yaml.safe_load(block), dict)
    for block in blocks(page, ("python",)):
        exec(compile(block, page.name, "exec"), {})  # noqa: S102
        assert capsys.readouterr().out
