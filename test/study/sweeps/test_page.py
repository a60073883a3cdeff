"""The report of a sweep, and what is told of the best settings."""

from __future__ import annotations

import shutil
import textwrap
from dataclasses import replace

import numpy as np
import pytest

from folders import ROOT

pytest.importorskip("distributed", reason="the extra 'sweep' is not installed")

from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.study.sweeps.objectives import score_of_runs
from adp_path_follower.study.sweeps.page import sweep_figures, write_sweep_page
from adp_path_follower.study.sweeps.request import read_sweep
from adp_path_follower.study.sweeps.results import results, results_text, write_results
from adp_path_follower.study.sweeps.study import score_of, sweep_study

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
ATTACK = "<img src=x onerror=alert(1)>"
SWEEP = f"""
settings:
  actor_gain: [1.0, 10.0, 100.0]
  target_gain: {{low: 0.1, high: 1.0}}
  save_weights_to: ["a.npz", "{ATTACK}"]
samples: 16
starts: [[0, 0, 0], [0.1, 0, 0]]
paths: [line, lissajous]
"""


def gain_loss(values) -> float:
    """Return a cost that has its least at actor_gain 10 and target_gain 0.5."""
    return 1.0 + abs(np.log10(values["actor_gain"]) - 1.0) + (values["target_gain"] - 0.5) ** 2


def results_of(sweep, unstable=()):
    """Return results of made-up runs whose costs are known; some have one unstable run."""
    return results(sweep_study(sweep, map(score_of_runs, runs_of(sweep, unstable))), sweep)


def runs_of(sweep, unstable):
    rng = np.random.default_rng(0)
    count = sweep.conditions.runs
    for number in range(sweep.combinations):
        cost = gain_loss(sweep.varied(number)) + np.array([0.0, 0.1, 0.2, 0.3])
        yield {
            "combination": np.full(count, number),
            "path": np.array(["line", "line", "lissajous", "lissajous"], dtype=object),
            "robot": np.full(count, "ideal", dtype=object),
            "cost": cost,
            "optimal_cost": np.full(count, 1.0),
            "cost_ratio": cost,
            "effort": 3.0 - cost + 0.01 * rng.uniform(size=count),
            "cross_track_rms": cost / 100.0,
            "cross_track_max": cost / 50.0,
            "settling_time": cost,
            "stable": np.array([number not in unstable, True, True, True]),
            "problem": np.full(count, "", dtype=object),
        }


@pytest.fixture
def sweep(tmp_path):
    file = tmp_path / "sweep.yaml"
    file.write_text(textwrap.dedent(SWEEP))
    return read_sweep(file)


def losses(sweep) -> np.ndarray:
    return np.array([gain_loss(sweep.varied(number)) for number in range(sweep.combinations)])


def test_the_best_is_the_best_that_is_stable(sweep, tmp_path):
    order = np.argsort(losses(sweep), kind="stable")
    found = results_of(sweep)
    assert [trial.number for trial in found.stable] == order.tolist()
    assert found.best == found.stable[0]
    least = losses(sweep)[order[0]]
    score = score_of(found.best)
    assert score.objectives["worst_case"] == pytest.approx(least + 0.3)
    assert score.objectives["cost"] == pytest.approx(least + 0.15)

    bad = set(order[:3].tolist())
    found = results_of(sweep, bad)
    assert found.best.number == order[3]
    assert {trial.number for trial in found.front} & bad == set()
    assert "96 settings tried for cost and effort, on 4 runs each; 3 unstable" in results_text(
        found
    )
    write_results(found, "mine", tmp_path)
    best = load_settings(Settings, "path_follower", tmp_path / "best.yaml")
    assert best == sweep.settings(order[3])

    nothing = results_of(sweep, range(96))
    assert nothing.best is None
    write_results(nothing, "mine", tmp_path)
    assert not (tmp_path / "best.yaml").exists()
    assert "no settings are stable in all runs" in results_text(nothing)


def drawn(found):
    return {key: figure for key, (_, _, figure) in sweep_figures(found).items()}


def test_heat_maps_show_what_matters_first(sweep):
    figures = drawn(results_of(sweep))
    first = figures["map_1"]
    # Two settings matter, the third does not; few values of target_gain are among the best.
    assert first["layout"]["xaxis"]["title"]["text"] == "target_gain"
    assert first["layout"]["yaxis"]["title"]["text"] == "actor_gain"
    field = np.array(first["data"][0]["z"], dtype=float)
    assert field.shape[0] == 3
    assert (np.nanargmin(field, axis=0) == 1).all()  # actor_gain: 10
    assert list(figures) == ["pareto", "map_1", "map_2", "map_3"]
    assert ATTACK not in str(figures["pareto"]["data"])

    assert not first["data"][1]["x"]
    bad = [n for n in range(sweep.combinations) if sweep.varied(n)["actor_gain"] == 100.0]
    figures = drawn(results_of(sweep, bad)).values()
    maps = [
        figure for figure in figures if figure["layout"]["yaxis"]["title"]["text"] == "actor_gain"
    ]
    assert {label for figure in maps for label in figure["data"][1]["y"]} == {"100"}


def test_a_run_that_never_settles_has_a_dash(sweep, tmp_path):
    """As nothing settles, there is no front to draw either."""
    conditions = replace(sweep, objectives=("cost", "settling_time"))
    runs = [run | {"settling_time": np.full(4, np.inf)} for run in runs_of(sweep, ())]
    found = results(sweep_study(conditions, map(score_of_runs, runs)), conditions)
    assert next(title for title, *_ in sweep_figures(found).values()) != "Pareto front"
    write_sweep_page(found, "x", tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count('<td class="value">–</td>') == 25
    assert "e+09" not in page


def test_it_names_the_cost_that_it_shows(sweep, tmp_path):
    """Costs are J/J*, or J where an optimum is not known; the page says which of both."""
    unknown = [run | {"optimal_cost": np.full(4, np.nan)} for run in runs_of(sweep, ())]
    for runs, cost in ((runs_of(sweep, ()), "J/J*"), (unknown, "J")):
        found = results(sweep_study(sweep, map(score_of_runs, runs)), sweep)
        write_sweep_page(found, "x", tmp_path / "report.html")
        page = (tmp_path / "report.html").read_text(encoding="utf-8")
        assert f"By cost (mean {cost} of the runs)" in page
        assert page.count(f"(mean {cost} of the runs)") >= 4


def test_where_nothing_is_stable_the_maps_show_how_much_is_not(sweep):
    found = results_of(sweep, range(96))
    figures = drawn(found)
    assert list(figures) == ["map_1", "map_2", "map_3"]
    for figure in figures.values():
        assert figure["data"][0]["colorbar"]["title"]["text"] == "unstable runs"
        shares = np.array(figure["data"][0]["z"], dtype=float)
        known = shares[np.isfinite(shares)]
        assert known.size
        assert known == pytest.approx(0.25)


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed: apt-get install chromium")
def test_the_page_opens_without_network_and_without_errors(sweep, tmp_path):
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    write_sweep_page(results_of(sweep, {0, 1}), ATTACK, tmp_path / "report.html")
    problems: list[str] = []
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu"]
        )
        page = browser.new_context(offline=True).new_page()
        page.on("console", lambda message: problems.append(message.text))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("dialog", lambda dialog: problems.append(dialog.message))
        page.goto((tmp_path / "report.html").as_uri())
        page.wait_for_selector("html[data-drawn=true]")
        drawn = page.locator(".figure .main-svg").count()
        text = page.inner_text("main")
        browser.close()
    assert drawn >= 4
    assert "Best settings" in text
    assert "Pareto front" in text
    assert problems == []


def test_the_files_of_the_page_are_installed():
    folder = ROOT / "adp_path_follower" / "drawing" / "templates"
    assert {"sweep.html.j2", "base.html.j2", "page.js", "page.css"} <= {
        file.name for file in folder.iterdir()
    }
