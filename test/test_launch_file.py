"""The launch file fits setup.py, the nodes and the docs; `launch` itself need not be installed."""

from __future__ import annotations

import ast
import re
import runpy

import pytest

from folders import ROOT

LAUNCH_FILE = ROOT / "launch" / "follow.launch.py"
DOCUMENTED = {
    "params_file",
    "path",
    "use_sim",
    "fault_script",
    "record",
    "bag",
    "namespace",
    "use_sim_time",
    "log_level",
    *("odom", "cmd_vel", "path_topic", "tf", "node_name", "autostart"),
    "movement_time_allowance",
}


def _calls(function: str) -> list[ast.Call]:
    """Return the calls of a function in the launch file."""
    tree = ast.parse(LAUNCH_FILE.read_text(encoding="utf-8"))
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == function
    ]


def _text(call: ast.Call, keyword: str) -> str:
    """Return a keyword argument that is a literal text."""
    (value,) = [argument.value for argument in call.keywords if argument.arg == keyword]
    return str(ast.literal_eval(value))


def _declared() -> dict[str, ast.Call]:
    return {ast.literal_eval(call.args[0]): call for call in _calls("DeclareLaunchArgument")}


def test_it_starts_executables_that_are_installed():
    scripts = re.findall(r'"(\w+) = [\w.]+:\w+"', (ROOT / "setup.py").read_text(encoding="utf-8"))
    executables = [_text(call, "executable") for call in _calls("Node")]
    assert sorted(executables) == ["controller", "path_publisher", "recorder", "sim_unicycle"]
    assert set(executables) <= set(scripts)


def test_nodes_keep_the_names_that_parameter_files_use():
    sources = [*ROOT.glob("adp_path_follower/ros/**/*.py"), ROOT / "sim_unicycle" / "node.py"]
    own_names = {
        name
        for file in sources
        for name in re.findall(r'^NODE_NAME = "(\w+)"', file.read_text(encoding="utf-8"), re.M)
    }
    names = re.findall(r'^ +name="(\w+)"', LAUNCH_FILE.read_text(encoding="utf-8"), re.M)
    assert {*names, _text(_declared()["node_name"], "default_value")} == own_names


def test_setup_installs_it_and_the_default_parameters():
    setup = (ROOT / "setup.py").read_text(encoding="utf-8")
    assert 'glob("launch/*.launch.py")' in setup
    assert 'glob("config/*.yaml")' in setup
    assert '"config", "default.yaml"' in LAUNCH_FILE.read_text(encoding="utf-8")
    assert (ROOT / "config" / "default.yaml").is_file()


def test_every_argument_is_declared_and_explained():
    declared = _declared()
    assert set(declared) == DOCUMENTED
    for call in declared.values():
        assert _text(call, "description").endswith(".")


def test_the_docs_use_declared_arguments_only():
    used = set()
    for document in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        commands = re.findall(
            r"follow\.launch\.py((?:\\\n|[^\n])*)", document.read_text(encoding="utf-8")
        )
        used |= {name for command in commands for name in re.findall(r"(\w+):=", command)}
    assert used <= set(_declared())


def test_launch_loads_it():
    pytest.importorskip("launch_ros", reason="launch is not on PyPI: needs a ROS 2 installation")
    # Imported here, where launch_ros exists: else `launch` would be this repository's directory.
    from launch import LaunchContext
    from launch_ros.actions import Node

    description = runpy.run_path(str(LAUNCH_FILE))["generate_launch_description"]()
    arguments = {argument.name: argument for argument in description.get_launch_arguments()}
    assert set(arguments) == DOCUMENTED
    for argument in arguments.values():
        assert argument.default_value is not None
        assert argument.description != "no description given"

    def started(**values: str) -> list[str]:
        context = LaunchContext()
        given = {"path": "line", "use_sim": "true", "record": "false", **values}
        context.launch_configurations.update(given)
        return [
            entity.node_executable
            for entity in description.entities
            if isinstance(entity, Node)
            and (entity.condition is None or entity.condition.evaluate(context))
        ]

    assert started(path="none") == ["controller", "sim_unicycle"]
    assert started() == ["controller", "path_publisher", "sim_unicycle"]
    assert started(use_sim="false") == ["controller", "path_publisher"]
    assert started(use_sim="false", record="true") == ["controller", "path_publisher", "recorder"]
