"""The front door: `import adp_path_follower as adp`."""

import ast
import subprocess
import sys
from pathlib import Path as FilePath

import numpy as np
import pytest

import adp_path_follower as adp
from adp_path_follower.core.errors import AdpError, FileError, PathError, SettingsError
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.simulation.simulate import simulate
from bag_messages import drive_on_line, write_bag
from commands import adp as command
from folders import CONFIG

POINTS = [[0.0, 0.0], [3.0, 0.0], [6.0, 1.0], [9.0, 1.0]]
START = (0.0, 0.3, 0.0)


def test_every_name_is_there_with_an_example_and_found_by_dir():
    assert set(adp.__all__) <= set(dir(adp))
    for name in adp.__all__:
        assert getattr(adp, name).__doc__
        if name.islower():
            assert "Example: `adp." in getattr(adp, name).__doc__, name
    with pytest.raises(AttributeError, match="simulat"):
        adp.simulat  # noqa: B018


def test_the_import_brings_nothing_else():
    script = (
        "import sys, adp_path_follower as adp\n"
        "print(*sorted({name.split('.')[0] for name in sys.modules}\n"
        "              & {'numpy', 'scipy', 'yaml', 'matplotlib', 'click', 'rclpy'}))\n"
        "adp.Driver\n"
        "print('matplotlib' in sys.modules, 'casadi' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.splitlines() == ["", "False False"], done.stderr


def test_types_are_visible_where_all_names_them():
    tree = ast.parse(FilePath(adp.__file__).read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    named = {alias.name for node in block.body for alias in node.names}
    assert named == set(adp.__all__)


def test_settings_by_name_by_file_and_with_changes(tmp_path):
    assert adp.load_settings() == build(Settings, {})
    assert adp.load_settings("paper") == adp.load_settings(CONFIG / "paper.yaml")
    file = tmp_path / "mine.yaml"
    file.write_text("/**:\n  ros__parameters:\n    desired_speed: 0.2\n")
    settings = adp.load_settings(file, max_linear_vel=0.4)
    assert settings == build(Settings, {"desired_speed": 0.2, "max_linear_vel": 0.4})
    assert settings.with_changes(desired_speed=0.3).target.desired_speed == 0.3
    assert settings.target.desired_speed == 0.2


@pytest.mark.parametrize(
    ("wrong", "error", "text"),
    [
        (lambda: adp.load_settings("papr"), FileError, "did you mean 'paper'?"),
        (lambda: adp.load_settings("zzz"), FileError, "available: default, diff_drive, late_robot"),
        (lambda: adp.load_settings("no.yaml"), FileError, "no.yaml"),
        (lambda: adp.load_settings(desired_sped=1.0), SettingsError, "'desired_speed'"),
        (lambda: adp.load_settings().with_changes(basis="zzz"), SettingsError, "polynomial"),
        (lambda: adp.path("liss"), PathError, "lissajous"),
        (lambda: adp.path([1.0, 2.0]), PathError, "shape (2,)"),
        (lambda: adp.path(object()), PathError, "points [x, y]"),
        (lambda: adp.simulate(POINTS, starts="here"), AdpError, "starts"),
        (lambda: adp.compare(POINTS, starts=[1.0]), AdpError, "starts"),
        (lambda: adp.compare(POINTS, controllers=["zzz"]), AdpError, "unknown controller 'zzz'"),
        (lambda: adp.simulate(POINTS, robot={"lag": 1.0}), SettingsError, "'lag'"),
    ],
)
def test_a_wrong_argument_is_named_in_one_sentence(wrong, error, text):
    with pytest.raises(error) as caught:
        wrong()
    assert text in str(caught.value)


def test_a_simulation_is_that_of_the_core(tmp_path):
    np.savetxt(tmp_path / "p.csv", POINTS, delimiter=",", header="x,y", comments="")
    path = named_path(str(tmp_path / "p.csv"))
    expected = simulate(build(Settings, {}), path, START, duration=2.0)
    for given in (POINTS, np.array(POINTS), tmp_path / "p.csv", str(tmp_path / "p.csv"), path):
        found = adp.simulate(given, starts=START, duration=2.0)
        assert found.cost == expected.cost
    lagging = adp.simulate(POINTS, starts=START, duration=2.0, robot={"velocity_lag": 0.2})
    assert lagging.cost != expected.cost


def test_results_say_in_one_line_what_was_found(tmp_path):
    pytest.importorskip("casadi", reason="J* needs CasADi")
    optimum = adp.optimum("line", start=START, horizon=15.0)
    compared = adp.compare("circle:1.0", controllers=["lqr"], starts=[START], duration=15.0)
    run = adp.analyze(write_bag(tmp_path / "bag", drive_on_line(lambda time: 0.02)))
    simulated = adp.simulate("line", starts=START, duration=1.0)
    assert repr(optimum).startswith(f"Optimum(J* {optimum.cost:.7g}, ")
    ratio = simulate_lqr_ratio = compared.outcomes[0].quantile(0.5)
    assert repr(compared) == f"Comparison(circle:1.0, 1 starts, median J/J*: lqr {ratio:.4f})"
    assert simulate_lqr_ratio > 1.0
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    assert compared.plot(axes) is axes
    assert axes.lines[0].get_xdata() == pytest.approx([ratio - 1.0])
    assert "cross-track RMS 20.00 mm" in repr(run)
    assert repr(simulated).startswith(f"SimulationResult(1 run: J {simulated.cost[0]:.6g} ")
    assert all("\n" not in repr(item) for item in (optimum, compared, run, simulated))


def test_results_plot_their_numbers_on_axes_that_are_given_or_new(tmp_path):
    from matplotlib import pyplot as plt

    plt.switch_backend("Agg")
    simulated = adp.simulate("line", starts=[START, (0.0, -0.1, 0.0)], duration=1.0, record=True)
    axes = plt.figure().subplots()
    assert simulated.plot(axes, run=1) is axes
    assert [line.get_label() for line in axes.lines] == ["s [m]", "y [m]", "θ [rad]"]
    np.testing.assert_array_equal(axes.lines[1].get_ydata(), simulated.trajectories.error[1, :, 1])
    run = adp.analyze(write_bag(tmp_path / "bag", drive_on_line(lambda time: 0.02)))
    assert np.allclose(run.plot().lines[1].get_ydata(), 0.02)
    for axes in (simulated.plot(), run.plot()):
        axes.figure.draw_without_rendering()
        legend = axes.get_legend().get_window_extent()
        assert legend.y0 >= axes.bbox.y1  # no curve is there
    plt.close("all")
    with pytest.raises(AdpError, match="record=True"):
        adp.simulate("line", starts=START, duration=0.1).plot()


@pytest.mark.smoke
def test_the_command_takes_parameters_by_name_as_by_file():
    by_name = command("parameters", "--params", "paper")
    by_file = command("parameters", "--params", str(CONFIG / "paper.yaml"))
    assert by_name.returncode == by_file.returncode == 0
    assert by_name.stdout == by_file.stdout


def test_the_command_names_the_nearest_parameters_and_all_of_them():
    done = command("simulate", "--params", "turtlebot")
    assert done.returncode == 2
    assert "unknown parameters 'turtlebot'; did you mean 'turtlebot4'?" in done.stderr
    assert "default, diff_drive, late_robot, paper, turtlebot4" in done.stderr
