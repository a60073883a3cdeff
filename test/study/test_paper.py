"""The reproduction of the paper: costs known from elsewhere, and the theorem's quantities."""

from __future__ import annotations

import json

import numpy as np
import pytest
from matplotlib.figure import Figure

from folders import ROOT

pytest.importorskip("casadi", reason="the extra 'optimum' is not installed")

from adp_path_follower.core.path.library import named_path
from adp_path_follower.study.paper import Reproduction, draw_paper, reproduce


@pytest.fixture(scope="module")
def found() -> Reproduction:
    return reproduce(lambda fraction: None, long_duration=30.0)


@pytest.mark.smoke
def test_costs_of_the_printed_laws(found):
    # Fourth-order integration in continuous time, done before this program was written.
    known = [0.6285, 0.5882, 0.5967, 0.6163]
    assert [run.cost for run in found.runs] == pytest.approx(known, rel=5e-3)
    assert found.optimum.cost == pytest.approx(0.541887, rel=1e-5)
    # The docs' numbers, which `bench/site/numbers.py` takes from this file, are not stale.
    kept = json.loads((ROOT / "docs" / "paper.json").read_text(encoding="utf-8"))
    for run, numbers in zip(found.runs, kept["runs"], strict=True):
        told = (run.cost, run.state_distance, run.input_distance)
        names = ("cost", "state_distance", "input_distance")
        assert told == pytest.approx([numbers[name] for name in names], rel=1e-4)
    assert kept["theorem"]["c_min"] == pytest.approx(found.theorem.excitation.min(), rel=1e-4)


def test_distances_are_those_of_the_trajectories(found):
    for run in found.runs:
        error = run.trajectories.error[0, ::100]
        times = run.trajectories.time[::100]
        nearest = [int(np.argmin(np.abs(found.optimum.time - time))) for time in times]
        # A coarse sum over whole seconds, at the nearest collocation point: a rough other way.
        rough = np.sqrt(((error - found.optimum.state[nearest, :3]) ** 2).sum(axis=1).mean())
        assert run.state_distance == pytest.approx(rough, rel=0.25)


def test_lateral_weights_are_unlearned_with_the_widest_grid(found):
    widest = found.long_runs[0]
    labels = widest.settings.learning.value_basis.labels
    final = dict(zip(labels, widest.trajectories.actor_weights[0, -1], strict=True))
    assert final["y θ"] == pytest.approx(-0.01, abs=0.01)
    assert final["y²"] == pytest.approx(-0.04, abs=0.01)


def test_value_along_the_run_is_the_cost_to_go(found):
    theorem = found.theorem
    assert theorem.value[0] == pytest.approx(found.optimum.cost, rel=1e-5)
    # Whatever the controller does, what it spends from one state to the next is at least the
    # value it gets rid of.
    run = found.shipped
    error, inputs = run.trajectories.error[0], run.trajectories.modified_input[0]
    rate = (error**2).sum(axis=1) + (inputs**2).sum(axis=1)
    spent = np.interp(theorem.time, run.trajectories.time, np.cumsum(rate) * 0.01)
    assert (np.diff(spent) + np.diff(theorem.value) > -5e-3 * theorem.value[:-1]).all()


def test_gain_conditions(found):
    theorem = found.theorem
    assert theorem.least_state_cost == pytest.approx(1.0)
    assert theorem.least_state_cost > theorem.cost_needed
    # N eta_a / (2 eta_c2) = 81 * 5 / 20 alone is beyond the certificate.
    assert theorem.excitation_needed > 20.25 > theorem.excitation.min() > 0.0
    assert (theorem.lyapunov >= theorem.value).all()
    assert theorem.residual.max() < 0.2


def test_the_drift_is_bounded_at_every_visited_state(found):
    # f of the printed error dynamics, written out, at the paper's start, where kappa is
    # that of the figure eight's crossing, 0, and phi = 0.
    s, y, theta = -0.5, 0.25, -np.pi / 6.0
    rates = np.array([-0.1 * s, 0.5 * np.sin(theta), 0.0, 0.05 * (0.5 * np.cos(theta) + 0.1 * s)])
    at_the_start = np.linalg.norm(rates) / np.linalg.norm([s, y, theta])
    assert found.theorem.drift_bound >= at_the_start * (1.0 - 1e-9)


def keeping(save, kept):
    """Return a function that saves figures, and keeps them."""

    def kept_and_saved(figure, *arguments, **options):
        kept.append(figure)
        save(figure, *arguments, **options)

    return kept_and_saved


@pytest.mark.smoke
def test_figures(found, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(Figure, "savefig", keeping(Figure.savefig, drawn))
    files = draw_paper(found, tmp_path)
    for figure in drawn:
        figure.draw_without_rendering()
        legends = [(axes, axes.get_legend()) for axes in figure.axes if axes.get_legend()]
        for axes, legend in legends:  # on no curve, whatever was drawn
            assert not legend.get_window_extent().overlaps(axes.bbox), axes.get_title()
    assert {file.name for file in files} >= {"figure_2_path.png", "lyapunov.png", "long_run.png"}
    assert all(file.stat().st_size > 10_000 for file in files)
    assert found.path.length == pytest.approx(named_path("lissajous").length)
