"""The value function on a grid, against offline optima, simulated costs and finite differences."""

import math

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from adp_path_follower.core.control import value_iteration, value_store
from adp_path_follower.core.control.value_iteration import ValueProblem
from adp_path_follower.core.control.value_store import problem_of, stored, value_grid
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.resources import config_file
from adp_path_follower.study.simulation.simulate import simulate

DEFAULT = build(Settings, {})
# Starts on the line and J* by collocation from six guesses, for the default limits, 40 s. From
# (-1.970, 1.718, 2.816) the six lead to 24.848, which this policy undercuts by 1.8 %: left out.
OPTIMA = {
    (1.25095467, 1.05056254, -3.05192412): 13.162026,
    (3.97213801, 1.37996581, 0.80715022): 43.866618,
    (2.75685690, 1.76450244, 1.84112194): 36.319238,
    (-2.74792810, -3.49211981, 0.08170392): 39.014594,
    (-1.99833715, -0.59686533, 1.41905376): 8.077046,
    (3.73553445, -2.60436038, -1.71893195): 69.875003,
    (-4.94734695, -0.97501702, -1.89424749): 66.967012,
    (3.21228418, -4.03295906, -0.85999873): 84.955978,
    (2.97069429, 4.67828051, -2.01435134): 77.214703,
    (-0.32065047, -2.84995963, -0.96722450): 24.655284,
    (-2.21574388, -1.99579919, 0.46076305): 13.210109,
}
STARTS = np.array(list(OPTIMA))


@pytest.fixture(scope="module")
def grid():
    return value_grid(DEFAULT)


def test_far_from_a_line_the_cost_is_the_optimum():
    result = simulate(
        DEFAULT, named_path("line"), STARTS, learning="warm", duration=40.0, rate=50.0
    )
    ratio = result.cost / list(OPTIMA.values())
    assert ratio.min() > 1.0 - 1e-5
    assert np.median(ratio) < 1.0005
    assert ratio.max() < 1.001


# J* at 0.22 m/s by collocation, 40 s, from 1.5 m before the figure eight's sharpest bend, and on a
# circle that is sharper still, where the layers of 1.2 1/m once had to do: up to 8 % more.
SLOW_OPTIMA = {
    "lissajous": {
        (-0.91, 0.143, -0.741): 1.6072746,
        (0.385, 0.632, -0.326): 2.4829923,
        (0.11, 0.883, -1.009): 2.6880096,
    },
    "circle:2": {
        (0.806, 0.865, -0.362): 3.0312102,
        (-0.428, -0.892, -0.244): 2.1782057,
        (-0.183, -0.909, -0.945): 3.4097678,
        (-0.13, 0.948, 0.833): 4.3912873,
        (0.353, -0.878, 0.116): 2.7055375,
    },
}


@pytest.mark.parametrize(("name", "place"), [("lissajous", 15.527), ("circle:2", 0.0)])
def test_slow_robots_leave_the_polynomial_nearer_to_the_path(name, place):
    slow, optima = build(Settings, {"desired_speed": 0.22}), SLOW_OPTIMA[name]
    result = simulate(
        slow,
        named_path(name),
        list(optima),
        learning="warm",
        duration=40.0,
        start_arc_length=place,
    )
    ratio = result.cost / list(optima.values())
    assert ratio.min() > 1.0 - 1e-5
    assert ratio.max() < 1.005


def test_the_value_is_the_cost_that_is_left_to_come(grid):
    for curvature in (0.25, 0.6):  # layers of the grid, where nothing is interpolated
        path = named_path(f"circle:{curvature}")
        result = simulate(DEFAULT, path, STARTS, learning="frozen", duration=40.0, rate=25.0)
        value, _ = grid.value_and_slope(STARTS, np.full(len(STARTS), curvature))
        # The grid interpolates: half of the starts within 0.5 %, a way round the back within 8 %.
        assert np.median(np.abs(result.cost / value - 1.0)) < 5e-3
        assert np.abs(result.cost / value - 1.0).max() < 0.08


def test_the_slope_is_that_of_the_value(grid):
    rng, step = np.random.default_rng(0), 1e-5
    errors = rng.uniform(-1.0, 1.0, (300, 3)) * [30.0, 30.0, 3.0]
    curvatures = rng.uniform(-2.0, 2.0, 300)
    _, slope = grid.value_and_slope(errors, curvatures)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ahead, _ = grid.value_and_slope(errors + shift, curvatures)
        behind, _ = grid.value_and_slope(errors - shift, curvatures)
        difference = (ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(slope[:, axis], difference, rtol=1e-4, atol=1e-3)


def test_the_slope_far_away_is_that_of_the_spline(grid):
    """W is (r rho)^2, with rho by scipy on the layer of a line."""
    distant, step, rng = grid.distant, 1e-4, np.random.default_rng(1)
    distance, bearing = rng.uniform(6.0, 60.0, 200), rng.uniform(-math.pi, math.pi, 200)
    place = np.stack([distance * np.cos(bearing), distance * np.sin(bearing)])

    def value(s, y):
        r = np.hypot(s, y)
        count, around = distant.axes.shape
        rows = (count - 1) * np.log(r / distant.axes.start)
        rows /= math.log(distant.axes.end / distant.axes.start)
        columns = np.mod((np.arctan2(y, s) / math.pi + 1.0) * around / 2.0, around)
        at = [rows + 1.0, columns + 1.0]
        return (r * map_coordinates(distant.coefficients[0], at, order=3, prefilter=False)) ** 2

    slope = distant.slope(place.T, np.zeros(200))
    for axis in range(2):
        shift = step * np.eye(2)[axis][:, None]
        difference = (value(*(place + shift)) - value(*(place - shift))) / (2.0 * step)
        np.testing.assert_allclose(slope[:, axis], difference, rtol=1e-4, atol=1e-2)
    mirror = np.array([1.0, -1.0])
    mirrored = distant.slope(place.T * mirror, np.full(200, -0.1)) * mirror
    np.testing.assert_allclose(mirrored, distant.slope(place.T, np.full(200, 0.1)), rtol=1e-9)


def test_one_robot_has_the_value_of_one_of_many_and_its_mirror_image(grid):
    for error, curvature in zip(STARTS, np.linspace(-1.0, 1.0, len(STARTS)), strict=True):
        value, slope = grid.value_and_slope(error, np.array(curvature))
        many = grid.value_and_slope(np.tile(error, (3, 1)), np.full(3, curvature))
        np.testing.assert_allclose(value, many[0][1], rtol=1e-12)
        mirror = np.array([1.0, -1.0, -1.0])
        mirrored, turned = grid.value_and_slope(error * mirror, np.array(-curvature))
        assert mirrored == pytest.approx(value, rel=1e-12)
        np.testing.assert_allclose(turned * mirror, slope, rtol=1e-9)


def test_heading_pi_and_minus_pi_have_one_value(grid):
    for place in ((3.0, 2.0), (-2.0, 4.0)):
        ends = [
            grid.value_and_slope(np.array([*place, t]), np.array(0.3)) for t in (-math.pi, math.pi)
        ]
        assert ends[0][0] == pytest.approx(ends[1][0], rel=1e-9)


def test_noise_does_not_keep_a_robot_between_two_ways():
    """Straight behind the target and facing away, left and right cost the same."""
    starts = np.array([[-4.0, 0.0, math.pi], [4.0, 0.0, math.pi], [4.0, 0.0, 0.0]])
    rng = np.random.default_rng(3)
    noisy = np.repeat(starts, 10, axis=0) + rng.normal(0.0, 1e-3, (30, 3))
    result = simulate(
        DEFAULT, named_path("line"), noisy, learning="frozen", duration=40.0, rate=50.0
    )
    assert not result.failed.any()
    assert np.linalg.norm(result.final_error, axis=1).max() < 0.05
    for same in result.cost.reshape(3, 10):
        assert np.ptp(same) < 0.01 * same.mean()


def fast(speed, most):
    return {"desired_speed": speed, "max_linear_vel": most, "max_angular_vel": most}


@pytest.mark.parametrize(
    ("name", "changes", "radius", "count", "duration"),
    [
        ("line", {}, 18.0, 100, 130.0),
        ("lissajous", {}, 25.0, 40, 80.0),
        # Eight of 300 once stayed where they faced backwards.
        (
            "line",
            fast(2.0, 3.0),
            3.0,
            300,
            30.0,
        ),
        # Once 37 of 60 drove on backwards, beside a target that did as well.
        (
            "line",
            fast(5.0, 9.0),
            6.0,
            60,
            20.0,
        ),
    ],
)
def test_every_robot_comes_to_the_path(name, changes, radius, count, duration):
    angles = np.random.default_rng(3).uniform(-math.pi, math.pi, (count, 2))
    place = radius * np.column_stack([np.cos(angles[:, 0]), np.sin(angles[:, 0])])
    result = simulate(
        build(Settings, changes),
        named_path(name),
        np.column_stack([place, angles[:, 1]]),
        learning="frozen",
        duration=duration,
        rate=25.0,
    )
    assert np.abs(result.final_error).max() < 0.05


def test_no_robot_without_limits_stays_aside_where_that_costs_much():
    """Values that rippled between the headings once kept robots of these costs aside for ever."""
    starts = np.random.default_rng(8).uniform(-1.0, 1.0, (60, 3))
    starts[:2] = [-0.832, 0.665, 0.601], [-0.967, 0.627, 0.864]
    free = {"min_linear_vel": -math.inf, "max_linear_vel": math.inf, "max_angular_vel": math.inf}
    result = simulate(
        build(Settings, {"state_cost": [1.0, 25.0, 1.0], **free}),
        named_path("lissajous"),
        starts,
        learning="warm",
        duration=20.0,
        rate=50.0,
    )
    assert np.abs(result.final_error).max() < 0.05


def test_the_values_of_a_slow_robot_settle(monkeypatch):
    """Robots that were kept between two ways once made values grow until the 400th sweep."""
    splines, filtered = [], value_iteration._filtered
    monkeypatch.setattr(value_iteration, "_CURVATURES", np.array([0.0, 0.25]))
    monkeypatch.setattr(
        value_iteration, "_filtered", lambda ratio: splines.append(ratio.shape) or filtered(ratio)
    )
    slow = load_settings(Settings, "path_follower", config_file("turtlebot4.yaml"))
    grid = value_iteration.solve(problem_of(slow))
    assert splines.count(grid.axes.shape) < 300  # of both layers


def test_what_is_stored_is_read_again_to_the_last_bit(grid, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(value_store, "_found", {})
    monkeypatch.setattr(value_store, "solve", lambda problem: grid)
    problem = problem_of(DEFAULT)
    assert stored(problem) is None
    again = value_grid(DEFAULT)
    assert again is not grid
    assert again.coefficients.tobytes() == grid.coefficients.tobytes()
    assert again.distant.coefficients.tobytes() == grid.distant.coefficients.tobytes()
    assert again.axes == grid.axes
    assert again.distant.axes == grid.distant.axes
    (file,) = (tmp_path / "adp_path_follower").iterdir()
    file.write_bytes(file.read_bytes()[:1000])
    value_store._found.clear()
    assert stored(problem) is None  # a damaged file is found anew


def test_a_home_that_cannot_be_written_costs_only_time(grid, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(value_store, "_found", {})
    monkeypatch.setattr(value_store, "solve", lambda problem: grid)
    assert value_grid(DEFAULT).coefficients.tobytes() == grid.coefficients.tobytes()


def test_a_speed_limit_for_now_and_phi_do_not_ask_for_another_one():
    same = build(Settings, {"speed_limit": 0.3, "path_state_gain": 0.2})
    assert problem_of(same) == problem_of(DEFAULT)
    other: ValueProblem = problem_of(build(Settings, {"max_linear_vel": 0.9}))
    assert other != problem_of(DEFAULT)
