"""The Riccati solution along a path: against its equation, symmetries and the error dynamics."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_are
from steady import steady_schedule

from adp_path_follower.core.control import error_dynamics
from adp_path_follower.core.control.riccati import (
    INPUT_MATRIX,
    riccati_solution,
    riccati_solutions,
    system_matrix,
)
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.path.library import circle, named_path
from adp_path_follower.core.settings.groups import CostSettings, TargetSettings

curvatures = st.floats(-10.0, 10.0)
targets = st.builds(
    TargetSettings, desired_speed=st.floats(0.05, 3.0), target_gain=st.floats(0.02, 5.0)
)
costs = st.builds(
    CostSettings,
    state_cost=st.tuples(*[st.floats(0.1, 10.0)] * 3),
    input_cost=st.tuples(*[st.floats(0.1, 10.0)] * 2),
)


def expected_system(curvature, target):
    """Return A row by row: the linear terms of s', y' and theta' as they are printed."""
    v, k1 = target.desired_speed, target.target_gain
    return np.array([[-k1, curvature * v, 0], [-curvature * v, 0, v], [-k1 * curvature, 0, 0]])


def residual(solution, curvature, target, cost):
    """Return A^T P + P A - P B R^-1 B^T P + Q."""
    a, b = expected_system(curvature, target), np.array([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    inverse = np.linalg.inv(cost.input_cost_matrix())
    gain = inverse @ b.T @ solution
    return a.T @ solution + solution @ a - solution @ b @ gain + cost.state_cost_matrix()


@settings(max_examples=60)
@given(curvature=curvatures, target=targets)
def test_the_system_is_the_error_dynamics_linearised(curvature, target):
    system = system_matrix(curvature, target, target.desired_speed)
    np.testing.assert_allclose(system, expected_system(curvature, target), atol=1e-12)
    h = 1e-5
    for axis in range(3):
        step = h * np.eye(4)[axis]
        ahead, behind = (
            error_dynamics.drift(at, np.asarray(curvature), target, target.desired_speed)[:3]
            for at in (step, -step)
        )
        np.testing.assert_allclose(system[:, axis], (ahead - behind) / (2.0 * h), atol=1e-6)
    on_path = error_dynamics.input_matrix(np.zeros(4))[:3]
    assert on_path.tolist() == INPUT_MATRIX.tolist()


wide = st.floats(-3.0, 3.0).map(lambda power: 10.0**power)


@settings(max_examples=100)
@given(
    nodes=st.lists(st.tuples(curvatures, wide), min_size=1, max_size=8),
    gain=wide,
    state_cost=st.tuples(*[wide | st.just(0.0)] * 3),
    input_cost=st.tuples(wide, wide),
)
def test_many_solutions_are_those_that_scipy_finds_one_by_one(nodes, gain, state_cost, input_cost):
    target, cost = TargetSettings(target_gain=gain), CostSettings(state_cost, input_cost)
    curvature, speed = np.array(nodes).T
    found = riccati_solutions(curvature, speed, target, cost)
    least = 1e-6 * max(1.0, sum(state_cost)) * np.eye(3)
    for number, (kappa, v_des) in enumerate(nodes):
        system = system_matrix(kappa, target, v_des)
        expected = solve_continuous_are(
            system, INPUT_MATRIX, np.diag(state_cost) + least, np.diag(input_cost)
        )
        np.testing.assert_allclose(found[number], expected, atol=1e-6 * np.abs(expected).max())


@settings(max_examples=100)
@given(curvature=curvatures, target=targets, cost=costs)
def test_solutions_satisfy_the_riccati_equation(curvature, target, cost):
    solution = riccati_solution(curvature, target.desired_speed, target, cost)
    assert solution.tolist() == solution.T.tolist()
    assert np.linalg.eigvalsh(solution)[0] > 0.0
    # A millionth of Q is added for errors that cost nothing.
    allowed = 1e-6 * max(1.0, sum(cost.state_cost)) * (1.0 + 1e-6) * np.eye(3)
    slack = 1e-9 * (1.0 + np.abs(solution).max() ** 2)
    found = residual(solution, curvature, target, cost)
    np.testing.assert_allclose(found + allowed, 0.0, atol=slack)


@settings(max_examples=100)
@given(curvature=curvatures, target=targets, cost=costs)
def test_the_closed_loop_is_stable_on_any_bend(curvature, target, cost):
    solution = riccati_solution(curvature, target.desired_speed, target, cost)
    gain = np.linalg.inv(cost.input_cost_matrix()) @ INPUT_MATRIX.T @ solution
    closed = expected_system(curvature, target) - INPUT_MATRIX @ gain
    assert np.linalg.eigvals(closed).real.max() < 0.0


@settings(max_examples=60)
@given(curvature=curvatures, target=targets, cost=costs)
def test_a_mirrored_path_has_the_mirrored_solution(curvature, target, cost):
    mirror = np.diag([1.0, -1.0, -1.0])
    right = riccati_solution(-curvature, target.desired_speed, target, cost)
    left = mirror @ riccati_solution(curvature, target.desired_speed, target, cost) @ mirror
    np.testing.assert_allclose(right, left, rtol=1e-8, atol=1e-8 * np.abs(left).max())


@settings(max_examples=40)
@given(factor=st.floats(0.01, 100.0), curvature=curvatures)
def test_solutions_are_proportional_to_the_cost(factor, curvature):
    target = TargetSettings()
    once = riccati_solution(
        curvature, target.desired_speed, target, CostSettings((2.0, 3.0, 4.0), (1.0, 2.0))
    )
    scaled = CostSettings((2.0 * factor, 3.0 * factor, 4.0 * factor), (factor, 2.0 * factor))
    found = riccati_solution(curvature, target.desired_speed, target, scaled) / factor
    np.testing.assert_allclose(found, once, rtol=2e-4, atol=1e-4)  # of the least cost


@pytest.mark.parametrize(
    "state_cost",
    [
        (0.0, 1.0, 0.0),
        (1.0, 1.0, 0.0),
        (0.0, 0.0, 1.0),
        (0.0, 0.0, 0.0),
        (1.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0),
    ],
)
@pytest.mark.parametrize("curvature", [-1.0, 0.0, 0.5])
def test_errors_may_cost_nothing(state_cost, curvature):
    target, cost = TargetSettings(), CostSettings(state_cost=state_cost)
    solution = riccati_solution(curvature, target.desired_speed, target, cost)
    closed = expected_system(curvature, target) - INPUT_MATRIX @ INPUT_MATRIX.T @ solution
    assert np.linalg.eigvals(closed).real.max() < 0.0
    found = residual(solution, curvature, target, cost)
    assert np.abs(found).max() < 1e-5


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of products beyond 1e308
def test_numbers_too_extreme_for_a_solution_are_refused_with_what_to_do():
    cost = CostSettings(state_cost=(1e200, 1.0, 1.0))
    with pytest.raises(SettingsError, match=r"state_cost.*curvature 2 1/m: choose values nearer"):
        riccati_solution(2.0, 0.5, TargetSettings(), cost)


# --- along a path -------------------------------------------------------------------------------


@settings(max_examples=60)
@given(place=st.floats(-200.0, 400.0))
def test_between_its_nodes_the_schedule_is_near_the_solution(figure_eight, place):
    target, cost = TargetSettings(), CostSettings()
    schedule = steady_schedule(figure_eight, target, cost)
    curvature = figure_eight.curvature(place)
    exact = riccati_solution(float(curvature), target.desired_speed, target, cost)
    found = schedule.matrix(curvature, 0.5)
    np.testing.assert_allclose(found, exact, atol=1e-3)
    gain = INPUT_MATRIX.T @ found
    closed = expected_system(float(curvature), target) - INPUT_MATRIX @ gain
    assert np.linalg.eigvals(closed).real.max() < -0.1


@pytest.mark.parametrize("curvature", [-2.0, -0.03, 0.5, 3.0])
def test_a_circle_has_its_own_solution_and_that_of_a_straight_line(curvature):
    target, cost = TargetSettings(), CostSettings()
    schedule = steady_schedule(circle(curvature), target, cost)
    for kappa in (curvature, 0.0):
        exact = riccati_solution(kappa, target.desired_speed, target, cost)
        np.testing.assert_allclose(schedule.matrix(np.asarray(kappa), 0.5), exact, atol=1e-4)


def test_beyond_the_table_the_nearest_solution_holds():
    target, cost = TargetSettings(), CostSettings()
    bend = circle(1.0)
    schedule = steady_schedule(bend, target, cost)
    ends = schedule.matrix(np.array([0.0, bend.curvature_range[1]]), 0.5)
    found = schedule.matrix(np.array([-5.0, -math.inf, 7.0, math.inf]), 0.5)
    assert found.tolist() == [ends[0].tolist()] * 2 + [ends[1].tolist()] * 2
    assert np.isfinite(schedule.matrix(np.asarray(math.nan), 0.5)).all()
    straight = steady_schedule(named_path("line"), target, cost)
    assert straight.matrix(np.zeros(()), 0.5).tolist() == (
        riccati_solution(0.0, target.desired_speed, target, cost).tolist()
    )


def test_a_bend_sharper_than_the_table_is_taken_for_its_sharpest():
    target, cost = TargetSettings(), CostSettings()
    schedule = steady_schedule(circle(20.0), target, cost)
    sharpest = riccati_solution(10.0, target.desired_speed, target, cost)
    np.testing.assert_allclose(schedule.matrix(np.asarray(20.0), 0.5), sharpest, rtol=1e-9)


def test_matrices_have_the_shape_of_the_curvatures(figure_eight):
    schedule = steady_schedule(figure_eight, TargetSettings(), CostSettings())
    several = figure_eight.curvature(np.linspace(0.0, 130.0, 12)).reshape(3, 4)
    together = schedule.matrix(several, 0.5)
    assert together.shape == (3, 4, 3, 3)
    for index in np.ndindex(3, 4):
        assert together[index].tolist() == schedule.matrix(several[index], 0.5).tolist()
