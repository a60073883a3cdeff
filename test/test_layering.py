"""The rooms of the house: imports run downwards only, and no room is overfull."""

import ast
import importlib
import subprocess
import sys
from pathlib import Path as FilePath

import pytest

import adp_path_follower
import sim_unicycle
from folders import ROOT

PACKAGE = FilePath(adp_path_follower.__file__).parent
SIMULATOR = FilePath(sim_unicycle.__file__).parent
PRODUCT = sorted([*PACKAGE.rglob("*.py"), *SIMULATOR.rglob("*.py")])
CORE = [file for file in PRODUCT if file.is_relative_to(PACKAGE / "core")]

A = "adp_path_follower"
GROUND = (f"{A}", f"{A}.threads", f"{A}.criteria", f"{A}.resources", f"{A}.extras")
# Bottom up. A module belongs to the longest prefix that it has; it may import its own place and
# the places below. A tuple holds places side by side, which may not import one another.
CORE_ORDER = [
    (
        f"{A}.core.errors",
        f"{A}.core.geometry",
        f"{A}.core.files",
        f"{A}.core.basis",
        f"{A}.core.registry",
        f"{A}.core.own_basis",
    ),
    (f"{A}.core.settings",),
    (f"{A}.core.path", f"{A}.core.safety"),
    (f"{A}.core.control",),
    (f"{A}.core.robot",),
    (f"{A}.core.learning",),
    (f"{A}.core.driving",),
]
STUDY_ORDER = [
    (f"{A}.study.simulation",),
    (f"{A}.study.optimum",),
    (f"{A}.study.comparison", f"{A}.study.paper", f"{A}.study.sweeps"),
    (f"{A}.study.replay",),
    (f"{A}.study.demo",),
]
ORDER = [
    *CORE_ORDER,
    (f"{A}.messages",),
    (f"{A}.bags",),
    (f"{A}.ros", f"{A}.drawing"),
    ("sim_unicycle",),
    *STUDY_ORDER,
    (f"{A}.analysis",),
    (f"{A}.front",),
    (f"{A}.cli",),
]
# The ground of core is one place: errors below, geometry and files and basis upon it.
SAME_PLACE = CORE_ORDER[0]

BLOCKED = [
    *("rclpy", "rosidl_runtime_py", "nav_msgs", "geometry_msgs", "std_msgs", "ament_index_python"),
    *("matplotlib", "click", "rosbags", "mcap", "casadi", "pandas", "tf2_ros", "launch"),
]
# numpy, scipy and PyYAML are all that the core may need.
ALLOWED_ROOTS = {*sys.stdlib_module_names, "numpy", "scipy", "yaml", "adp_path_follower"}
SIMULATION = [
    "adp_path_follower.study.simulation.simulate",
    "sim_unicycle.unicycle",
    "sim_unicycle.fault_script",
    "sim_unicycle.odometry",
    "sim_unicycle.settings",
]
MODULES_IN_A_ROOM = 14


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


def place(name):
    """Return rank and prefix of the place that a module belongs to, or None."""
    found = [
        (len(prefix), rank, prefix)
        for rank, prefixes in enumerate(ORDER)
        for prefix in prefixes
        if name == prefix or name.startswith(f"{prefix}.")
    ]
    return max(found)[1:] if found else None


def test_the_core_is_found():
    assert len(CORE) > 40
    assert PACKAGE / "core" / "driving" / "follower.py" in CORE


@pytest.mark.parametrize("file", PRODUCT, ids=module_name)
def test_imports_run_downwards_only(file):
    here = place(module_name(file))
    if here is None:  # the ground beside the rooms, and the empty packages that hold them
        return
    for name in imported(file):
        there = place(name)
        if there is None or there[1] == here[1]:
            continue
        beside = here[1] in SAME_PLACE and there[1] in SAME_PLACE
        assert there[0] < here[0] or beside, f"{module_name(file)} imports {name}"


@pytest.mark.parametrize("file", PRODUCT, ids=module_name)
def test_every_import_is_found(file):
    """Type checkers take a module that is missing for one without types; so are lazy imports."""
    modules = {module_name(other) for other in PRODUCT}
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in (A, "sim_unicycle"):
            assert node.module in modules, f"{module_name(file)} imports {node.module}"
            module = importlib.import_module(node.module)
            for alias in node.names:
                known = f"{node.module}.{alias.name}" in modules
                assert known or hasattr(module, alias.name), f"{node.module} has no {alias.name}"


def test_every_module_has_a_place():
    packages = {f"{A}.core", f"{A}.study"}
    homeless = {module_name(file) for file in PRODUCT if place(module_name(file)) is None}
    assert homeless <= {*GROUND, *packages}


def test_an_import_upwards_is_found(tmp_path):
    file = tmp_path / "upwards.py"
    file.write_text("def late():\n    from adp_path_follower.cli import main\n")
    (name,) = (name for name in imported(file) if place(name) and name.endswith("main"))
    assert place(name)[0] > place(f"{A}.core.path.curve")[0]


@pytest.mark.parametrize(
    "folder",
    sorted({file.parent for file in [*PRODUCT, *(ROOT / "bench").rglob("*.py")]}),
    ids=lambda folder: folder.name,
)
def test_no_folder_is_overfull(folder):
    modules = [file for file in folder.glob("*.py") if file.name != "__init__.py"]
    assert len(modules) <= MODULES_IN_A_ROOM


@pytest.mark.parametrize(
    "file",
    [file for file in PRODUCT if file.name == "__init__.py" and "data" not in file.parts],
    ids=module_name,
)
def test_every_room_says_what_it_may_import_and_what_it_never_does(file):
    docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8")))
    assert docstring
    if file.parent == PACKAGE:
        return  # the front door says what it gives
    assert "May import" in docstring
    assert "Never" in docstring


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


@pytest.mark.parametrize("file", CORE, ids=module_name)
def test_the_core_imports_only_itself_and_numbers(file):
    for name in imported(file):
        assert name.split(".")[0] in ALLOWED_ROOTS
        if name.startswith("adp_path_follower"):
            assert name in ("adp_path_follower", "adp_path_follower.core") or name.startswith(
                "adp_path_follower.core."
            ), f"{file.name} imports {name}"


@pytest.mark.parametrize("room", ["bags", "analysis", "drawing", "messages"])
def test_middle_rooms_do_not_import_ros(room):
    for file in PRODUCT:
        if module_name(file).startswith(f"{A}.{room}"):
            assert not {name for name in imported(file) if name.startswith("rclpy")}, file


@pytest.mark.parametrize("file", PRODUCT, ids=module_name)
def test_no_module_is_longer_than_400_lines(file):
    assert len(file.read_text(encoding="utf-8").splitlines()) <= 400
