"""The core stands alone: no ROS, no plotting, nothing of the layers above it."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import adp_path_follower
import sim_unicycle

PACKAGE = Path(adp_path_follower.__file__).parent
SIMULATOR = Path(sim_unicycle.__file__).parent
CORE = sorted((PACKAGE / "core").rglob("*.py"))
PRODUCT = sorted([*PACKAGE.rglob("*.py"), *SIMULATOR.rglob("*.py")])

BLOCKED = [
    *("rclpy", "rosidl_runtime_py", "nav_msgs", "geometry_msgs", "std_msgs", "ament_index_python"),
    *("matplotlib", "click", "rosbags", "mcap", "casadi", "pandas", "tf2_ros", "launch"),
]
# numpy, scipy and PyYAML are all that the core may need.
ALLOWED_ROOTS = {*sys.stdlib_module_names, "numpy", "scipy", "yaml", "adp_path_follower"}
SIMULATION = [
    "adp_path_follower.study.simulation.simulate",
    "sim_unicycle.disturbances",
    "sim_unicycle.fault_script",
    "sim_unicycle.odometry",
    "sim_unicycle.settings",
    "sim_unicycle.unicycle",
]


def module_name(file):
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(file):
    """Return the absolute names of everything that a file imports, at any depth."""
    found = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file} has a relative import"
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def test_the_core_is_found():
    assert len(CORE) > 10
    assert PACKAGE / "core" / "driving" / "follower.py" in CORE


@pytest.mark.parametrize(
    "modules", [[module_name(file) for file in CORE], SIMULATION], ids=["core", "simulation"]
)
def test_modules_import_without_ros_and_plotting(modules):
    script = (
        "import importlib, sys\n"
        f"for name in {BLOCKED!r}:\n"
        "    sys.modules[name] = None\n"
        f"for name in {modules!r}:\n"
        "    importlib.import_module(name)\n"
        "print('imported')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=PACKAGE.parent,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.stdout.strip() == "imported", done.stderr


def test_blocking_an_import_works():
    script = "import sys\nsys.modules['click'] = None\nimport click\n"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=False)
    assert done.returncode != 0


@pytest.mark.parametrize("file", CORE, ids=lambda file: file.name)
def test_the_core_imports_only_itself_and_numbers(file):
    for name in imported(file):
        assert name.split(".")[0] in ALLOWED_ROOTS
        if name.startswith("adp_path_follower"):
            assert name in ("adp_path_follower", "adp_path_follower.core") or name.startswith(
                "adp_path_follower.core."
            ), f"{file.name} imports {name}"


@pytest.mark.parametrize("layer", ["bags", "analysis", "simulation", "sweeping"])
def test_middle_layers_import_no_nodes_and_no_command_line(layer):
    above = ("adp_path_follower.ros", "adp_path_follower.cli", "sim_unicycle.node", "rclpy")
    for file in PRODUCT:
        if module_name(file).startswith(f"adp_path_follower.{layer}"):
            reached = {name for name in imported(file) if name.startswith(above)}
            assert not reached, f"{file} imports {reached}"


@pytest.mark.parametrize("file", PRODUCT, ids=module_name)
def test_no_module_is_longer_than_400_lines(file):
    assert len(file.read_text(encoding="utf-8").splitlines()) <= 400
