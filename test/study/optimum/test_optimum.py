"""The offline optimum against values computed elsewhere, and against its necessary conditions."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import subprocess
import sys

import numpy as np
import pytest

from commands import adp
from folders import DATA

casadi = pytest.importorskip("casadi", reason="the extra 'optimum' is not installed")

from adp_path_follower.core.control.riccati import riccati_solution
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.robot.robot import settings_of
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.optimum.collocation import Optimum, OptimumSolver
from adp_path_follower.study.optimum.costate import Extremal, solve_costates
from adp_path_follower.study.optimum.problem import OptimumError
from adp_path_follower.study.simulation.simulate import simulate
from sim_unicycle.settings import PlantSettings

REFERENCE = json.loads((DATA / "optimum.json").read_text())
PAPER_START = REFERENCE["figure_eight"]["start"]
UNLIMITED = {
    "min_linear_vel": -math.inf,
    "max_linear_vel": math.inf,
    "max_angular_vel": math.inf,
}
LATE = {"command_delay": 0.1, "gains": (0.97, 1.03), "bias": 0.05}
CORNER = "x,y\n0,0\n1,0\n2,0\n3,0\n3,1\n3,2\n3,3\n3,8\n"
PATHS = {"lissajous": "lissajous", "line": "line", "circle0.5": "circle:0.5"}
PATHS["circle1.0"] = "circle:1.0"
EVERY = 8  # of the forty starts; bench/endurance/optima.py solves all


@functools.cache  # what is transcribed for one test serves the others
def solver(
    path: str = "lissajous", horizon: float = 30.0, place: float = 0.0, **settings: object
) -> OptimumSolver:
    built = build(Settings, {**UNLIMITED, **settings})
    return OptimumSolver(built, named_path(path), place, horizon)


@functools.cache  # so are optima
def optimum_from(start: tuple[float, ...], **settings: object) -> Optimum:
    return solver(**settings).solve(np.array(start))


@pytest.mark.parametrize("key", PATHS)
def test_agrees_with_reference_values(key):
    costs = REFERENCE["forty_starts"][key]["costs"]
    optimum = solver(PATHS[key])
    starts = REFERENCE["forty_starts"]["e0"]
    found = [optimum.solve(np.array(start)) for start in starts[::EVERY]]
    assert [item.cost for item in found] == pytest.approx(costs[::EVERY], rel=1e-5)
    assert max(item.horizon_change for item in found) < 1e-6
    assert not any(item.local_optima for item in found)


@pytest.mark.parametrize(
    ("curvature", "cost"),
    REFERENCE["constant_curvature_costs_from_the_same_start"].items(),
)
def test_agrees_on_circles(curvature, cost):
    path = "line" if curvature == "0" else f"circle:{curvature}"
    assert solver(path).solve(np.array(PAPER_START)).cost == pytest.approx(cost, rel=1e-6)


def test_agrees_with_the_reference_motion():
    reference = REFERENCE["figure_eight"]
    motion = optimum_from(tuple(PAPER_START)).motion
    for row, column in enumerate(("s", "y", "theta")):
        # Straight lines between collocation points are good to what the reference is rounded to
        # only where the points lie close.
        found = np.interp(reference["t"], motion.time, motion.state[:, row])
        expected = np.array(reference["e"])[:, row]
        assert found == pytest.approx(expected, abs=2e-3), column
    assert motion.modified_input[0] == pytest.approx(reference["u"][0], abs=1e-5)


@pytest.mark.parametrize(
    ("settings", "start"),
    [
        ({}, PAPER_START),
        ({}, [0.8, -0.6, 0.9]),
        ({"state_cost": (1.0, 3.0, 0.5), "input_cost": (2.0, 0.5)}, [0.3, 0.4, -0.5]),
        ({"state_cost": (1.0, 0.2, 0.0, 0.2, 2.0, 0.1, 0.0, 0.1, 1.0)}, [0.3, 0.4, -0.5]),
        ({"input_cost": (1.0, 0.3, 0.3, 2.0)}, [0.3, 0.4, -0.5]),
        ({"min_linear_vel": 0.0, "max_linear_vel": 1.0, "max_angular_vel": 1.5}, [1.0, 1.0, 1.0]),
        ({"max_lateral_accel": 0.1, "place": 15.5}, [0.8, 0.3, 0.3]),
    ],
)
def test_collocation_and_costates_agree(settings, start):
    found = optimum_from(tuple(start), **settings)
    extremal = solve_costates(solver(**settings).problem, found.motion)
    assert extremal.cost == pytest.approx(found.cost, rel=1e-6)


def test_costates_are_the_gradient_of_the_optimal_cost():
    optimum, start, step = solver(), np.array([0.4, -0.3, 0.5]), 1e-3
    extremal = solve_costates(optimum.problem, optimum.solve(start).motion)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ahead, behind = optimum.solve(start + shift).cost, optimum.solve(start - shift).cost
        assert extremal.costates[axis] == pytest.approx((ahead - behind) / (2.0 * step), rel=1e-4)


def test_limits_hold_and_cost():
    limits = {"min_linear_vel": 0.0, "max_linear_vel": 1.0, "max_angular_vel": 1.5}
    start = (1.0, 1.0, 1.0)
    motion = optimum_from(start, **limits).motion
    linear = 0.5 + motion.modified_input[1:, 0]
    curvature = named_path("lissajous").curvature(motion.state[1:, 3])
    angular = 0.5 * curvature + motion.modified_input[1:, 1]
    assert linear.min() > -1e-6
    assert linear.max() < 1.0 + 1e-6
    assert np.abs(angular).max() < 1.5 + 1e-6
    assert motion.cost > optimum_from(start).cost * 1.01


def test_no_controller_is_better_than_the_optimum():
    """Bellman's word: whatever policy is simulated, J is not below J*."""
    path, rng = named_path("lissajous"), np.random.default_rng(3)
    starts = rng.uniform(-1.0, 1.0, (6, 3))[:4]
    best = np.array([optimum_from(tuple(start)).cost for start in starts])
    costs = [
        simulate(
            build(Settings, {**UNLIMITED, **assignments}), path, starts, duration=20.0, rate=25.0
        ).cost
        for assignments in ({}, {"learning": False}, {"basis_degree": 3})
    ]
    assert len({cost.tobytes() for cost in costs}) == 3  # policies that differ
    assert (np.array(costs) > best * (1.0 - 1e-5)).all()


def test_on_the_path_nothing_is_to_be_won():
    assert solver("circle:0.5").solve(np.zeros(3)).cost == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("start", [[math.nan, 0.0, 0.0], [0.0, 0.0], [math.inf, 1.0, 1.0]])
def test_refuses_starts_that_are_none(start):
    with pytest.raises(OptimumError, match="must be finite values s, y, theta"):
        solver().solve(np.array(start))


@pytest.mark.parametrize("horizon", [-1.0, math.nan, math.inf, 1e7])
def test_refuses_a_horizon_that_is_none(horizon):
    with pytest.raises(OptimumError, match="but must be above 0 and at most 1000"):
        solver(horizon=horizon)


def test_refuses_more_path_than_it_can_prepare():
    with pytest.raises(OptimumError, match=r"covers 9.*e\+03 m within the horizon"):
        solver(horizon=300.0, desired_speed=20.0)


def test_turns_the_shorter_way_round():
    starts = np.array([[2.0, 3.0, 3.1], [2.0, -3.0, -3.1]])
    optimum = solver("line", horizon=15.0)
    driven = simulate(
        build(Settings, UNLIMITED), optimum.problem.path, starts, duration=15.0, rate=25.0
    ).cost
    for start, cost in zip(starts, driven, strict=True):
        found = optimum.solve(start)
        assert found.cost < cost < found.guesses[-1]  # a controller beats the other way round
        assert found.local_optima
        with pytest.raises(OptimumError, match="the heading error passes pi"):
            solve_costates(optimum.problem, found.motion)


def test_where_the_turn_is_limited_in_a_corner_the_costates_agree(tmp_path):
    corner = tmp_path / "corner.csv"
    corner.write_text(CORNER)
    limits = {"min_linear_vel": 0.0, "max_linear_vel": 1.0, "max_angular_vel": 1.5}
    optimum = solver(str(corner), horizon=8.0, **limits)
    found = optimum.solve(np.array([0.1, 0.1, 0.1]))
    assert found.mesh_change < 1e-6
    assert solve_costates(optimum.problem, found.motion).cost == pytest.approx(found.cost, rel=1e-5)


def test_theta_counts_as_the_heading_that_it_is():
    optimum = solver("line", horizon=15.0)
    first, second = (
        optimum.solve(np.array([0.5, 0.5, turn])).cost for turn in (0.4, 0.4 + 4 * math.pi)
    )
    assert first == pytest.approx(second, rel=1e-9)


def test_the_mesh_follows_the_corners_of_a_path(tmp_path):
    corner = tmp_path / "corner.csv"
    corner.write_text(CORNER)
    optimum = solver(str(corner))
    found = optimum.solve(np.array([0.1, 0.1, 0.1]))
    # 640 intervals of the mesh that knows nothing of corners gave 0.070469232.
    assert found.cost == pytest.approx(0.070469232, rel=1e-6)
    assert found.mesh_change < 1e-6
    assert solve_costates(optimum.problem, found.motion).cost == pytest.approx(found.cost, rel=1e-5)


@pytest.mark.smoke
def test_the_command_writes_what_it_found(tmp_path):
    done = adp(
        "optimum",
        *("--check", "--json", "o.json", "--npz", "o.npz", "--figure", "o.png"),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    (entry,) = json.loads((tmp_path / "o.json").read_text())["optima"]
    assert entry["converged"]
    assert entry["cost"] == pytest.approx(REFERENCE["figure_eight"]["cost"], rel=1e-6)
    assert entry["costate_cost"] == pytest.approx(entry["cost"], rel=1e-7)
    arrays = np.load(tmp_path / "o.npz", allow_pickle=False)
    assert arrays["state_0"].shape == (len(entry["t"]), 4)
    assert (tmp_path / "o.png").stat().st_size > 10_000
    assert "0.5418868" in done.stdout


def test_a_start_without_an_optimum_is_named_and_the_others_are_there(tmp_path):
    done = adp(
        "optimum",
        *("--start", "nan", "0", "0", "--start", "0.1", "0.1", "0.1", "--json", "o.json"),
        cwd=tmp_path,
    )
    assert done.returncode == 1
    assert "start is [nan, 0.0, 0.0]" in done.stderr
    assert "Traceback" not in done.stderr
    bad, good = json.loads((tmp_path / "o.json").read_text())["optima"]
    assert not bad["converged"]
    assert good["converged"]


def test_an_optimum_of_a_short_horizon_is_called_so(tmp_path):
    done = adp("optimum", "--horizon", "1", "--json", "o.json", cwd=tmp_path)
    assert done.returncode == 1
    assert "with a horizon half as long again: give a longer --horizon" in done.stderr
    (entry,) = json.loads((tmp_path / "o.json").read_text())["optima"]
    assert not entry["converged"]


def test_a_check_that_disagrees_is_said(monkeypatch):
    from adp_path_follower.study.optimum import costate

    extremal = Extremal(0.5418868 * (1.0 + 2e-5), np.zeros(4))
    monkeypatch.setattr(costate, "solve_costates", lambda problem, motion: extremal)
    done = adp("optimum", "--check")
    assert done.returncode == 1
    assert "is 0.5418868 by collocation, but 0.5418976 by costates" in done.stderr


def test_where_the_speed_varies_costates_are_the_gradient_along_the_path_too():
    start, step, limits = np.array([0.8, 0.3, 0.3]), 1e-2, {"max_lateral_accel": 0.1}
    here = solver(place=15.5, **limits)
    extremal = solve_costates(here.problem, here.solve(start).motion)
    ahead, behind = (
        solver(place=15.5 + shift, **limits).solve(start).cost for shift in (step, -step)
    )
    assert extremal.costates[3] == pytest.approx((ahead - behind) / (2.0 * step), rel=1e-3)


def test_a_profile_that_is_constant_is_a_constant_speed():
    """On the circle 0.08 m/s^2 across are 0.4 m/s; near the path J* is e^T P e there."""
    profile = solver("circle:0.5", max_lateral_accel=0.08)
    constant = solver("circle:0.5", desired_speed=0.4)
    assert profile.problem.reference.varies
    assert not constant.problem.reference.varies
    for start in (np.array([0.3, 0.4, -0.5]), np.array([3e-3, 2e-3, -1e-3])):
        expected = constant.solve(start).cost
        assert profile.solve(start).cost == pytest.approx(expected, rel=1e-6)
    settings = constant.problem.settings
    matrix = riccati_solution(0.5, 0.4, settings.target, settings.cost)
    assert expected == pytest.approx(start @ matrix @ start, rel=1e-2)


ACCELERATIONS = {"max_linear_accel": 0.5, "max_linear_decel": 0.5, "max_angular_accel": 1.0}


def test_limits_of_acceleration_hold_and_cost():
    start = (0.5, 0.6, 0.4)
    limited = solver(place=15.5, horizon=15.0, **ACCELERATIONS)
    motion = limited.solve(np.array(start)).motion
    command = motion.modified_input + limited.problem.feedforward(motion.state[:, 3])
    times = np.arange(0.0, 5.0, 0.2)
    held = np.stack([np.interp(times, motion.time, column) for column in command.T])
    fastest = np.abs(np.diff(held) / 0.2).max(axis=1)
    assert fastest[0] == pytest.approx(0.5, rel=0.01)
    assert fastest[1] == pytest.approx(1.0, rel=0.01)
    assert (np.abs(command[0]) < np.array([0.5, 1.0]) * 0.005 + 1e-6).all()  # half of 10 ms
    assert optimum_from(start).cost * 1.02 < optimum_from(start, max_angular_accel=1.0).cost


@pytest.mark.parametrize(
    ("plant", "settings"),
    [
        (PlantSettings(), {"max_angular_accel": 1.0}),
        (
            PlantSettings(velocity_lag=0.2, angular_lag=0.3, **LATE),
            {"max_linear_vel": 0.6, "max_angular_vel": 1.0},
        ),
        (PlantSettings(velocity_lag=0.2, command_ramps=(1.0, 2.0), **LATE), {}),
    ],
    ids=["acceleration", "late", "ramp"],
)
def test_the_optimum_is_that_of_shooting_with_held_commands(plant, settings):
    """Poses on a line; commands are held for 20 ms each, and their changes bounded."""
    count, step, start, v_des, robot = 300, 0.02, (0.2, 0.5, 0.3), 0.5, plant.model
    # x, y, theta, place of the target, cost, and the wheels' velocities
    state, held = casadi.SX.sym("state", 7), casadi.SX.sym("held", 2)
    lags = (robot.linear_lag, robot.angular_lag)
    v, w = robot.motion(*[state[5 + i] if lag else held[i] for i, lag in enumerate(lags)])
    along, heading = state[0] - state[3], state[2]
    moved = (v * casadi.cos(heading), v * casadi.sin(heading), w)
    target_speed = v_des * casadi.cos(heading) + 0.1 * along
    cost = along**2 + state[1] ** 2 + heading**2 + (v - v_des) ** 2 + w**2
    answers = [(held[i] - state[5 + i]) / lag if lag else 0.0 for i, lag in enumerate(lags)]
    rate = casadi.vertcat(*moved, target_speed, cost, *answers)
    rates = casadi.Function("rates", [state, held], [rate])
    slopes = [rates(state, held)]
    for share in (0.5, 0.5, 1.0):
        slopes.append(rates(state + share * step * slopes[-1], held))
    after = state + step / 6.0 * (slopes[0] + 2.0 * slopes[1] + 2.0 * slopes[2] + slopes[3])
    drive = casadi.Function("drive", [state, held], [after]).mapaccum(count)
    commands = casadi.MX.sym("commands", 2, count)
    acting = casadi.horzcat(casadi.MX(2, round(robot.delay / step)), commands)[:, :count]
    program = {
        "x": casadi.vec(commands),
        "f": drive(casadi.DM([*start, 0.0, 0.0, 0.0, 0.0]), acting)[4, -1],
        "g": casadi.vec(casadi.diff(casadi.horzcat(casadi.MX(2, 1), commands), 1, 1)),
    }
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes"}
    options["ipopt.hessian_approximation"] = "limited-memory"
    shooting = casadi.nlpsol("shooting", "ipopt", program, options)
    built = build(Settings, {**UNLIMITED, **settings, "controller_frequency": 1.0 / step})
    known = OptimumSolver(built, named_path("line"), 0.0, count * step, plant)
    (lower, upper), change = known.problem.limits(), step * known.problem.rates()[1]
    found = shooting(
        x0=np.tile([v_des, 0.0], count),
        lbx=np.tile(lower, count),
        ubx=np.tile(upper, count),
        lbg=np.tile(-change, count),
        ubg=np.tile(change, count),
    )
    assert known.solve(np.array(start)).cost == pytest.approx(float(found["f"]), rel=1e-4)


def test_ways_that_began_elsewhere_lead_to_the_optimum_from_the_start():
    start = np.array([0.5, 0.6, -0.4])
    motion = optimum_from(tuple(start)).motion
    noisy = motion.state + np.array([0.02, -0.03, 0.01 + 2.0 * math.pi, 0.05])
    found = solver().solve(start, [dataclasses.replace(motion, state=noisy)])
    assert found.cost == pytest.approx(motion.cost, rel=1e-8)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_angular_jerk": 1.0}, "knows no limits of jerk"),
        ({"max_linear_accel": 1.0}, "max_linear_accel and max_linear_decel to the same"),
        ({"path": "line", "place": 90.0, **ACCELERATIONS}, "stops at the end of the path"),
    ],
)
def test_refuses_what_it_does_not_know(settings, message):
    with pytest.raises(OptimumError, match=message):
        solver(**settings)


def test_the_speed_limit_counts():
    limits = {"max_linear_vel": 1.0, "speed_limit": 0.6}
    optimum = solver(**limits)
    found = optimum.solve(np.array([-1.0, 0.2, 0.1]))
    assert 0.5 + found.motion.modified_input[:, 0].max() == pytest.approx(0.6, abs=1e-6)
    assert solve_costates(optimum.problem, found.motion).cost == pytest.approx(found.cost, rel=1e-6)


def test_a_path_is_prepared_as_the_parameters_say(tmp_path):
    (tmp_path / "corner.csv").write_text("x,y\n0,0\n3,0\n3,3\n")
    costs = []
    for tolerance in (0.02, 0.2):
        done = adp(
            *("optimum", "--path", "corner.csv", "--set", f"path_tolerance={tolerance}"),
            *("--start", "0.1", "0.1", "0.1", "--start-arc-length", "2", "--horizon", "12"),
            *("--json", "o.json"),
            cwd=tmp_path,
        )
        assert done.returncode == 0, done.stderr
        (entry,) = json.loads((tmp_path / "o.json").read_text())["optima"]
        costs.append(entry["cost"])
    assert costs[0] != pytest.approx(costs[1], rel=1e-3)


def test_without_casadi_the_command_names_the_extra(tmp_path):
    (tmp_path / "casadi.py").write_text("raise ImportError('not here')\n")
    done = subprocess.run(
        [sys.executable, "-m", "adp_path_follower.cli.main", "optimum"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=120,
        check=False,
    )
    assert done.returncode == 2
    assert "pip install 'adp_path_follower[optimum]'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_a_known_late_robot_is_driven_nearly_as_well_as_can_be():
    """A delay costs what the robot does until its first command acts, and hardly more."""
    start, plant = np.array([0.3, 0.5, 0.4]), PlantSettings(command_delay=0.2, velocity_lag=0.3)
    settings = build(Settings, {"robot_model": "given", **settings_of(plant.model)})
    path = named_path("lissajous")
    optimum = OptimumSolver(settings, path, horizon=15.0, plant=plant).solve(start)
    ideal = OptimumSolver(settings, path, horizon=15.0).solve(start)
    driven = simulate(settings, path, start, duration=15.0, learning="warm", plant=plant)
    assert 1.05 * ideal.cost < optimum.cost <= driven.cost[0] <= 1.002 * optimum.cost
