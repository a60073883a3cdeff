"""The examples run, and the paper's method in one file is the product with config/paper.yaml."""

import runpy
import subprocess
import sys

import numpy as np
import pytest

import adp_path_follower as adp
from folders import ROOT

EXAMPLES = ROOT / "examples"


@pytest.fixture(scope="module")
def one_file():
    return runpy.run_path(str(EXAMPLES / "paper_in_one_file.py"))


def test_the_paper_in_one_file_drives_as_the_product_does(one_file):
    *found, cost = one_file["run"](one_file["figure_eight"](), 20.0)
    run = adp.simulate("lissajous", "paper", duration=20.0, record=True)
    motion = run.trajectories
    product = (motion.pose, motion.error, motion.command, motion.critic_weights)
    for ours, theirs in zip(found, (*product, motion.actor_weights), strict=True):
        np.testing.assert_allclose(ours, theirs[0], rtol=0.0, atol=1e-9)
    assert cost == pytest.approx(run.cost[0], rel=1e-4)


def test_the_paper_in_one_file_is_short_and_draws(one_file, tmp_path):
    assert len((EXAMPLES / "paper_in_one_file.py").read_text().splitlines()) <= 200
    errors, weights = np.ones((5, 3)), np.ones((5, 9))
    one_file["plot"](tmp_path / "paper.png", errors, weights, 0.5)
    assert (tmp_path / "paper.png").stat().st_size > 5000


def run_example(name, *arguments):
    """Run an example as its user does; return the lines that it prints."""
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_own_path():
    path, result, costs = run_example("own_path.py", 6)
    assert path.startswith("Path(open, ")
    assert result.startswith("SimulationResult(3 runs: J ")
    assert result.endswith("0 failed)")
    assert costs.count(",") == 2


def test_own_basis():
    lines = run_example("own_basis.py", 6)
    assert len(lines) == 2
    assert all("1 settled" in line and "0 failed" in line for line in lines)


def test_own_controller():
    pytest.importorskip("casadi", reason="J* needs CasADi")
    comparison, far = run_example("own_controller.py", 15)
    assert comparison.startswith("Comparison(circle:1.0, 2 starts, median J/J*: adp 1.0")
    assert "proportional" in comparison
    assert "1 settled" in far


def test_read_a_bag(tmp_path):
    from bag_messages import drive_on_line, write_bag

    bag = write_bag(tmp_path / "bag", drive_on_line(lambda time: 0.02))
    lines = run_example("read_a_bag.py", bag)
    assert lines[0].startswith("BagAnalysis(bag: ")
    assert lines[1].startswith("cross_track_max")


@pytest.mark.parametrize(
    ("name", "said"), [("paper_in_an_hour", "J/J* = 1.000"), ("my_robot_from_a_bag", "In tried")]
)
def test_the_notebook_runs_from_top_to_bottom_and_shows_pictures(name, said, tmp_path, monkeypatch):
    nbclient = pytest.importorskip("nbclient", reason="notebooks need the extra 'test'")
    nbformat = pytest.importorskip("nbformat", reason="notebooks need the extra 'test'")
    pytest.importorskip("casadi", reason="J* needs CasADi")
    from torn_bags import write_run

    write_run(tmp_path / "my_bag")
    command = f'exec {sys.executable} -m adp_path_follower.cli.main "$@"'
    (tmp_path / "adp").write_text(f"#!/bin/sh\n{command}\n")
    (tmp_path / "adp").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    book = nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in book.cells), "clear its outputs"
    nbclient.NotebookClient(book, timeout=300, resources={"metadata": {"path": tmp_path}}).execute()
    shown = [item for cell in book.cells for item in cell.get("outputs", ())]
    assert sum("image/png" in item.get("data", {}) for item in shown) >= 2
    text = "".join(item.get("text", "") for item in shown)
    assert said in text, text
