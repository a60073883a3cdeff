"""Simulated runs as a page shows them."""

import numpy as np
import pytest

pytest.importorskip("plotly", reason="the report needs the extra 'report'")

from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.drawing.page import Table, write_runs_page
from adp_path_follower.drawing.page_figures import page_data
from adp_path_follower.study.simulation.shown import shown_run
from adp_path_follower.study.simulation.simulate import simulate
from sim_unicycle.fault_script import without_nodes
from sim_unicycle.settings import SimulatorSettings


def test_the_cost_so_far_is_that_of_a_pushed_robot(tmp_path):
    """J is of the true motion: a push is no part of what the controller commanded."""
    settings, path = build(Settings, {"learning": False}), named_path("line")
    plant, faults = without_nodes(build(SimulatorSettings, {"fault_script": "push"}))
    result = simulate(settings, path, duration=7.0, plant=plant, faults=faults, record=True)
    run = shown_run("pushed", path, settings, result.trajectories)
    assert run.charts.panels["cost"][0].lines[0].values[-1] == result.cost[0]


def test_a_script_shades_the_times_at_which_it_acts(tmp_path):
    """Once for all runs; the page names the script beside the settings."""
    entries = "{at: 1, for: 0.3, push: [0, 1, 0]}, {at: 0.5, for: 0.2, every: 1, linear_slip: 0.1}"
    (tmp_path / "script.yaml").write_text(f"faults: [{entries}]", encoding="utf-8")
    robot = build(SimulatorSettings, {"fault_script": str(tmp_path / "script.yaml")})
    settings, path = build(Settings, {"learning": False, "wide_region": "none"}), named_path("line")
    plant, faults = without_nodes(robot)
    starts = np.array([[0.0, 0.1, 0.0], [0.0, 0.2, 0.0]])
    result = simulate(settings, path, starts, duration=3.0, plant=plant, faults=faults, record=True)
    runs = [
        shown_run(name, path, settings, result.trajectories, run, 2, faults)
        for run, name in enumerate(("left", "farther"))
    ]
    shaded = runs[0].charts.halts["disturbed"]
    for time in np.arange(0.005, 3.0, 0.01):
        acts = any(begin <= time < end for begin, end in shaded)
        assert acts == (faults.settings_at(robot, time) != robot)
    drawn = page_data(runs)["figures"]["cost"]["layout"]["shapes"]
    assert sum(shape.get("name") == "disturbed" for shape in drawn) == len(shaded) == 4
    file = tmp_path / "page.html"
    write_runs_page(file, "Two", "", "adp", [settings, robot], (), runs, Table(("start",), ()))
    page = file.read_text(encoding="utf-8")
    assert "The fault script acts in grey." in page
    assert "fault_script" in page
