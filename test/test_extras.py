"""Optional libraries: nothing needs them on import, and one sentence names what is missing."""

import subprocess
import sys
from pathlib import Path as FilePath

import pytest

import adp_path_follower
from adp_path_follower.core.errors import AdpError
from adp_path_follower.extras import EXTRAS, Library, require

PACKAGE = FilePath(adp_path_follower.__file__).parent
# The nodes are for those who have ROS; `test_layering` blocks it for the core.
WITHOUT_ROS = ["cli", "analysis", "study", "drawing", "bags", "messages"]
# Modules, no packages, that a command imports after it has required their extra.
REQUIRED_BEFORE = (
    "analysis/bag_page",
    "drawing/page_figures",
    "study/sweeps/",
)


def test_nothing_needs_an_optional_library_on_import_or_changes_the_backend_of_matplotlib():
    blocked = sorted({name for extra in EXTRAS.values() for name in extra})
    modules = sorted(
        ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
        for room in WITHOUT_ROS
        for file in (PACKAGE / room).rglob("*.py")
        if file.name == "__init__.py"
        or (
            not str(file.relative_to(PACKAGE)).startswith(REQUIRED_BEFORE)
            and "rclpy" not in file.read_text(encoding="utf-8")
        )
    )
    assert len(modules) > 70
    script = (
        "import importlib, sys\n"
        f"for name in {blocked!r}:\n"
        "    sys.modules[name] = None\n"
        "import matplotlib\n"
        "backend = matplotlib.rcParams._get_backend_or_none()\n"
        f"for name in {modules!r}:\n"
        "    importlib.import_module(name)\n"
        "assert matplotlib.rcParams._get_backend_or_none() == backend\n"
        "print('imported')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout.strip() == "imported", done.stderr


@pytest.mark.parametrize("extra", EXTRAS)
def test_what_is_missing_is_named_with_its_remedy(extra, monkeypatch):
    require("adp test", extra)  # all is installed here
    for name in EXTRAS[extra]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(AdpError) as refused:
        require("adp test", extra)
    text = str(refused.value)
    assert text.startswith("adp test needs ")
    assert text.endswith(f"pip install 'adp_path_follower[{extra}]'")


def test_a_library_is_imported_at_its_first_use_only(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    casadi = Library("casadi", "the offline optimum", "optimum")
    with pytest.raises(AdpError) as refused:
        casadi.MX.sym("x")
    assert str(refused.value) == (
        "the offline optimum needs CasADi: pip install 'adp_path_follower[optimum]'"
    )


def test_a_library_that_does_not_fit_the_others_is_named_with_its_remedy(tmp_path, monkeypatch):
    (tmp_path / "pyarrow.py").write_text("raise ImportError('needs numpy 2')\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "pyarrow", raising=False)
    with pytest.raises(AdpError) as refused:
        require("adp sweep", "sweep")
    assert str(refused.value) == (
        "adp sweep needs another pyarrow (needs numpy 2): with numpy 1, pip install 'pyarrow<26'"
    )
