"""`adp compare`: its numbers against those of other commands, and what it does with failures."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import subprocess
import sys
import warnings

import numpy as np
import pytest
from steady import steady_target

from adp_path_follower.core.driving.output import ControlOutput
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.path.library import circle, named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.comparison import compare as comparison
from adp_path_follower.study.comparison.compare import Comparison, Outcome, compare
from adp_path_follower.study.comparison.controllers import CONTROLLERS, Contender, contender
from adp_path_follower.study.comparison.figures import draw_comparison
from adp_path_follower.study.simulation.simulate import simulate
from commands import adp
from folders import DATA
from sim_unicycle.fault_script import without_nodes
from sim_unicycle.settings import SimulatorSettings

OPTIMUM = json.loads((DATA / "optimum.json").read_text())
UNLIMITED = {
    "min_linear_vel": -math.inf,
    "max_linear_vel": math.inf,
    "max_angular_vel": math.inf,
}
STARTS = np.array(OPTIMUM["forty_starts"]["e0"])[:3]
DURATION = 15.0  # [s] of the 30 s of the reference: what is left then costs nothing


@pytest.fixture(scope="module")
def found():
    """Return three quick controllers from three starts on a circle."""
    names = ["adp", "lqr", "lapierre_soetanto"]
    return compare(
        build(Settings, UNLIMITED), "circle:1.0", circle(1.0), STARTS, names, duration=DURATION
    )


def test_optima_are_those_of_the_reference(found):
    np.testing.assert_allclose(
        found.optimal_cost, OPTIMUM["forty_starts"]["circle1.0"]["costs"][:3], rtol=1e-5
    )
    assert found.problems == ()


def test_costs_are_those_of_a_simulation_of_the_same_controller(found):
    for name, outcome in zip(("adp", "lqr"), found.outcomes, strict=False):
        item = contender(name, build(Settings, UNLIMITED))
        result = simulate(
            item.settings,
            circle(1.0),
            STARTS,
            duration=DURATION,
            learning=item.learning,
            controller=item.factory,
            rate=item.rate,
        )
        np.testing.assert_allclose(outcome.cost, result.cost, rtol=1e-9)
        np.testing.assert_allclose(outcome.cost_ratio * found.optimal_cost, result.cost, rtol=1e-9)
        assert not outcome.failed.any()


def test_nobody_is_better_than_the_optimum_and_the_learned_policy_is_nearest(found):
    best = {outcome.name: outcome.quantile(1.0) for outcome in found.outcomes}
    assert min(outcome.cost_ratio.min() for outcome in found.outcomes) > 1.0 - 1e-4
    assert best["adp"] < 1.005 < best["lqr"] < best["lapierre_soetanto"]


def test_where_guesses_fail_the_way_of_a_controller_leads_to_the_optimum(monkeypatch):
    """From here the guesses alone led to 24.85, and the cheapest way turns past pi."""
    monkeypatch.setattr(comparison, "_LONGEST_LAP", 1.0)
    start = np.array([[-1.970, 1.718, 2.816]])
    found = compare(build(Settings, {}), "line", named_path("line"), start, ["adp"], duration=12.0)
    assert found.problems == ()
    assert found.optimal_cost[0] < 24.42
    assert 1.0 - 1e-5 < found.outcomes[0].cost_ratio[0] < 1.001


LIMITS = {"max_linear_accel": 1.0, "max_linear_decel": 1.0, "max_angular_accel": 6.0}


@pytest.mark.parametrize("limits", [{}, LIMITS], ids=["velocity", "acceleration"])
def test_nobody_is_better_where_the_speed_varies_along_the_path(monkeypatch, limits):
    monkeypatch.setattr(comparison, "_LONGEST_LAP", 1.0)
    settings, path = build(Settings, {"max_lateral_accel": 0.1, **limits}), named_path("lissajous")
    found = compare(
        settings, "lissajous", path, STARTS[:1], ["adp", "lqr"], start_arc_length=15.5, duration=9.0
    )
    assert found.problems == ()
    ours, lqr = (float(outcome.cost_ratio[0]) for outcome in found.outcomes)
    assert 1.0 - 1e-5 < ours < min(1.05, lqr)


@pytest.mark.parametrize("setting", ["max_lateral_accel", "max_angular_accel"])
def test_a_controller_that_knows_no_speed_or_limits_of_the_others_is_refused(monkeypatch, setting):
    item = Contender("standing", build(Settings, {}), Standing, "frozen", rate=20.0)
    monkeypatch.setattr(comparison, "contender", lambda *_: item)
    settings, path = build(Settings, {setting: 0.1}), named_path("lissajous")
    with pytest.raises(AdpError, match="'standing' knows neither a speed that varies"):
        compare(settings, "lissajous", path, STARTS[:1], ["x"])


def test_an_optimum_that_a_controller_undercuts_is_none(monkeypatch):
    monkeypatch.setattr(comparison, "_LONGEST_LAP", 1.0)
    solve = comparison.OptimumSolver.solve

    def dearer(*arguments):
        found = solve(*arguments)
        motion = dataclasses.replace(found.motion, cost=2.0 * found.cost)
        return dataclasses.replace(found, motion=motion)

    monkeypatch.setattr(comparison.OptimumSolver, "solve", dearer)
    plant, faults = without_nodes(SimulatorSettings())  # as commands give them
    settings, path, starts = build(Settings, UNLIMITED), circle(1.0), STARTS[:1]
    robot = {"plant": plant, "faults": faults}
    found = compare(settings, "circle:1.0", path, starts, ["lqr"], duration=6.0, **robot)
    assert "is only a local one" in found.problems[0]
    assert np.isnan(found.outcomes[0].cost_ratio).all()


def test_a_lap_is_measured_after_its_first_ten_seconds(found):
    lap = 2.0 * math.pi / 0.5
    for outcome in found.outcomes:
        assert outcome.lap_time[0] == pytest.approx(10.0)
        assert outcome.lap_time[-1] == pytest.approx(10.0 + lap, abs=0.011)
        assert outcome.cross_track_rms <= outcome.cross_track_max


class Standing:
    """A controller that never moves."""

    def __init__(self, settings, path, arc_length):
        self.settings, self.path = settings, path
        self.target = steady_target(path, settings.target, arc_length)

    def step(self, pose, dt):
        """Return a zero command."""
        frame, error = self.target.move(pose, dt)
        command = np.zeros((len(pose), 2))
        return ControlOutput(
            command, command, error, frame.pose, self.target.arc_length, frame.curvature
        )


def test_the_distance_from_the_path_is_that_to_its_nearest_place(monkeypatch):
    item = Contender("standing", build(Settings, UNLIMITED), Standing, "frozen", rate=20.0)
    monkeypatch.setattr(comparison, "contender", lambda *_: item)
    result = compare(
        build(Settings, UNLIMITED),
        "line",
        named_path("line"),
        np.array([[0.0, 2.0, 0.0]]),
        ["x"],
        duration=5.0,
        start_arc_length=80.0,  # a lap of the 20 m that are left
    )
    (outcome,) = result.outcomes
    assert outcome.failed.all()  # two metres from the path at the end
    assert math.isinf(outcome.quantile(0.5))
    np.testing.assert_allclose(outcome.cross_track, 0.25, atol=1e-9)  # the paper's start


def test_starts_without_an_optimum_count_in_all_but_the_ratio():
    outcome = Outcome(
        name="x",
        cost_ratio=np.array([1.0, 3.0, math.nan, math.nan]),
        cost=np.ones(4),
        failed=np.array([False, False, False, True]),
        settling_time=np.ones(4),
        effort=np.ones(4),
        lap_time=np.ones(1),
        cross_track=np.array([-2.0]),
        step_time=1e-3,
        lap=None,  # of the page
    )
    assert outcome.quantile(0.0) == 1.0
    assert outcome.quantile(0.5) == 3.0
    assert outcome.quantile(1.0) == math.inf  # the failure
    assert outcome.cross_track_max == 2.0


def test_the_paper_runs_with_its_own_learner_on_the_same_problem():
    task = build(Settings, {**UNLIMITED, "desired_speed": 0.3, "input_cost": (2.0, 1.0)})
    item = contender("paper", task)
    assert (item.settings.target, item.settings.cost) == (task.target, task.cost)
    assert item.settings.learning.basis == "paper"


@pytest.mark.smoke
def test_the_command_writes_table_numbers_and_figures(tmp_path):
    done = subprocess.run(
        [
            *(sys.executable, "-m", "adp_path_follower.cli.main", "compare", "--unlimited"),
            *("--path", "circle:1.0", "--start", "-0.5", "0.25", "-0.5", "--out", "out"),
            *("--controllers", "adp,lqr", "--duration", "10"),
        ],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=120,
        env={**os.environ, "COLUMNS": "100"},
    )
    assert done.returncode == 0, done.stderr
    table = (tmp_path / "out" / "compare.txt").read_text()
    assert table.strip() in done.stdout
    numbers = json.loads((tmp_path / "out" / "compare.json").read_text())["paths"][0]
    assert [item["name"] for item in numbers["controllers"]] == ["adp", "lqr"]
    assert f"{numbers['controllers'][0]['cost_ratio_median']:.4f}" in table
    for name in ("cost.png", "cross_track.png", "cost_per_step.png"):
        assert (tmp_path / "out" / name).stat().st_size > 5000


def test_the_list_names_every_controller_even_without_casadi(tmp_path):
    (tmp_path / "casadi.py").write_text("raise ImportError('not here')\n")
    done = subprocess.run(
        [sys.executable, "-m", "adp_path_follower.cli.main", "compare", "--list"],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=tmp_path,
    )
    assert [line.split()[0] for line in done.stdout.splitlines()] == list(CONTROLLERS)


def test_a_start_that_is_none_does_not_keep_the_others_from_running(tmp_path):
    starts = ["--start", "nan", "0", "0", "--start", "0.1", "0.1", "0.1"]
    done = adp(
        *("compare", "--path", "circle:1.0", *starts, "--controllers", "lqr", "--out", "out"),
        *("--duration", "10"),
        cwd=tmp_path,
    )
    assert done.returncode == 1
    assert "start is [nan, 0.0, 0.0], but must be finite" in done.stderr
    assert "circle:1.0, 2 starts, J* known of 1" in done.stdout
    (found,) = json.loads((tmp_path / "out" / "compare.json").read_text())["paths"]
    (lqr,) = found["controllers"]
    assert lqr["cost"][0] is None
    assert lqr["failed"] == [False, False]
    assert 1.0 < lqr["cost_ratio_max"] < 1.1
    assert lqr["cost_ratio_max"] * found["optimal_cost"][1] == pytest.approx(lqr["cost"][1])


def test_a_start_that_costs_nothing_is_told_as_far_beyond_the_optimum(tmp_path):
    """From the path itself J* is zero but for rounding, and J/J* has twenty digits."""
    pytest.importorskip("plotly", reason="the page needs the extra 'report'")
    on_path, beside = ("--start", "0", "0", "0"), ("--start", "0", "0.2", "0")
    done = adp(
        *("compare", "--unlimited", *on_path, *beside, "--controllers", "stanley"),
        *("--duration", "5", "--path", "circle:0.5", "--out", "out"),
        cwd=tmp_path,
    )
    assert ">100" in done.stdout
    page = (tmp_path / "out" / "race.html").read_text(encoding="utf-8")
    assert re.findall(r'class="value" data-value="([^"]*)">&gt;100<', page)
    assert "&gt;100 at most" in page


def test_what_there_is_to_say_about_the_optimum_is_below_the_table(tmp_path):
    done = adp(
        *("compare", "--unlimited", "--path", "circle:1.0", "--start", "2", "3", "3.1"),
        *("--duration", "3", "--controllers", "lqr", "--out", "out"),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    table = (tmp_path / "out" / "compare.txt").read_text()
    assert "from [2.0, 3.0, 3.1] the starting guesses led to different local optima" in table
    assert "J* of 1 starts is the best over 3 s alone" in table


def test_a_lap_of_an_open_path_ends_with_the_path():
    found = compare(
        build(Settings, UNLIMITED),
        "line",
        named_path("line"),
        STARTS[:1],
        ["lqr"],
        duration=5.0,
        start_arc_length=90.0,
    )
    (outcome,) = found.outcomes
    assert outcome.lap_time[0] == 10.0
    assert outcome.lap_time[-1] == pytest.approx(20.0, abs=0.5)  # 10 m at 0.5 m/s
    short = compare(
        build(Settings, UNLIMITED),
        "line",
        named_path("line"),
        STARTS[:1],
        ["lqr"],
        duration=5.0,
        start_arc_length=98.0,
    )
    assert math.isnan(short.outcomes[0].cross_track_max)


@pytest.mark.parametrize("optimal", [1.0, math.nan])
def test_figures_where_every_run_failed_say_so(tmp_path, optimal):
    lost = Outcome(
        name="x",
        cost_ratio=np.full(2, math.nan),
        cost=np.full(2, math.nan),
        failed=np.ones(2, dtype=bool),
        settling_time=np.full(2, math.inf),
        effort=np.full(2, math.nan),
        lap_time=np.zeros(0),
        cross_track=np.zeros(0),
        step_time=1e-3,
        lap=None,  # of the page
    )
    found = Comparison("line", np.zeros((2, 3)), np.full(2, optimal), (), (), (lost,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        files = draw_comparison(found, tmp_path)
    assert all(file.stat().st_size > 1000 for file in files)


def test_the_median_of_two_starts_is_their_mean():
    ratio, zeros = np.array([1.0, 1.5]), np.zeros(2)
    outcome = Outcome("x", ratio, ratio, zeros > 0.0, zeros, zeros, zeros, zeros, 0.0, None)
    assert outcome.quantile(0.5) == 1.25
    assert outcome.quantile(0.95) == outcome.quantile(1.0) == 1.5
