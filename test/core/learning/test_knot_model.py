"""Bellman errors at scattered samples: against the paper's formulas, one sample after the other."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.learning.knot_model import KnotModel, NormalEquations, fit
from adp_path_follower.core.learning.samples import scattered_samples
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

seeds = st.integers(0, 2**32 - 1)
UNLIMITED = (-math.inf, math.inf, math.inf)
ROBOT = (0.0, 1.0, 1.5)
NARROW = (-0.2, 0.6, 0.3)
WIDTHS = (1.2, 0.8, 1.5, 0.5)
COSTS = {
    "unit": ((1.0, 1.0, 1.0), (1.0, 1.0)),
    "diagonal": ((2.0, 0.5, 1.0), (0.5, 3.0)),
    "full": ((1.0, 0.2, 0.0, 0.2, 2.0, 0.1, 0.0, 0.1, 1.0), (1.0, 0.3, 0.3, 2.0)),
}


def tuning(degree=3, frame="half_angle", limits=UNLIMITED, costs="unit", **values):
    names = ("min_linear_vel", "max_linear_vel", "max_angular_vel")
    return build(
        Settings,
        {
            "basis_degree": degree,
            "frame": frame,
            **dict(zip(names, limits, strict=True)),
            "state_cost": COSTS[costs][0],
            "input_cost": COSTS[costs][1],
            "sample_count": 160,
            "sample_half_widths": WIDTHS,
            **values,
        },
    )


def policy(printed, gradient, error, kappa, actor, input_cost, limits):
    """Return u = -1/2 R^-1 g^T sigma'^T Wa, clipped so that the command keeps the limits."""
    g = printed.input_matrix([*error, 0.0])[:3]
    steady = np.array([printed.v_des, kappa * printed.v_des])
    v, w = -0.5 * np.linalg.solve(input_cost, g.T @ gradient.T @ actor) + steady
    lowest, highest, turn = limits
    return np.array([min(max(v, lowest), highest), min(max(w, -turn), turn)]) - steady


def samples_one_by_one(printed, polynomial, states, costs, limits, ahead, kappa, spacing):
    """Return of each sample: importance, regressor and constant of delta, and running cost."""
    state_cost, input_cost = costs
    rows = []
    for error in states:
        gradient, value = polynomial.gradient(error), polynomial.value(error).real
        applied = policy(printed, gradient, error, kappa, ahead, input_cost, limits)
        zeta = [*error, 0.0]
        rate = printed.drift(zeta, kappa) + printed.input_matrix(zeta) @ applied
        omega = gradient @ rate[:3]
        spent = error @ state_cost @ error + applied @ input_cost @ applied
        passing = value * (printed.v_des * math.cos(error[2]) + printed.k1 * error[0]) / spacing
        # delta = spent + w omega + (w_ahead - w) passing
        distance = math.hypot(*(error / np.array(WIDTHS[:3])))
        importance = distance**-4 / (1.0 + omega @ omega)
        rows.append((importance, omega - passing, spent + ahead @ passing, spent))
    return [np.array(column) for column in zip(*rows, strict=True)]


# --- the samples --------------------------------------------------------------------------------


@settings(max_examples=30)
@given(
    count=st.integers(16, 3000),
    widths=st.tuples(*[st.floats(0.01, 50.0)] * 3),
    seed=st.integers(0, 999_999),
)
def test_samples_lie_in_the_box_and_are_the_same_by_seed(count, widths, seed):
    found = scattered_samples(count, widths, seed)
    assert found.shape == (count, 3)
    assert (np.abs(found) <= widths).all()
    assert (np.abs(found).max(axis=1) > 0.0).all()
    assert found.tobytes() == scattered_samples(count, widths, seed).tobytes()
    assert found.tobytes() != scattered_samples(count, widths, seed + 1).tobytes()


@pytest.mark.parametrize("seed", range(5))
def test_samples_fill_the_box_and_more_of_them_lie_near_the_path(seed):
    found = scattered_samples(1024, (1.0, 2.0, 3.0), seed) / [1.0, 2.0, 3.0]
    assert np.abs(found.mean(axis=0)).max() < 0.05
    octants, members = np.unique(found > 0.0, axis=0, return_counts=True)
    assert len(octants) == 8
    assert members.min() > 0.8 * 1024 / 8
    inner = np.abs(found).max(axis=1)
    assert (inner > 0.9).mean() > 0.15
    assert (inner < 0.1).mean() > 0.02  # evenly scattered, one in a thousand


def test_a_model_has_the_samples_of_its_settings():
    model = KnotModel(tuning(sample_count=100, sample_seed=7), 0.2)
    assert len(model) == 100
    expected = scattered_samples(100, WIDTHS[:3], 7)
    assert model.states.tobytes() == expected.tobytes()


# --- the normal equations -----------------------------------------------------------------------


@pytest.mark.parametrize("costs", sorted(COSTS))
@pytest.mark.parametrize("limits", [UNLIMITED, ROBOT, NARROW], ids=["free", "robot", "narrow"])
@pytest.mark.parametrize(("degree", "frame"), [(2, "serret_frenet"), (3, "half_angle")])
def test_equations_are_the_sums_of_the_formulas(printed, explicit, costs, limits, degree, frame):
    polynomial = explicit(degree, frame)
    matrices = printed.costs(dict(zip(("state_cost", "input_cost"), COSTS[costs], strict=True)))
    random = np.random.default_rng(degree)
    for kappa, spacing in ((0.0, 0.2), (-0.7, 0.05), (2.0, 1.0)):
        model = KnotModel(tuning(degree, frame, limits, costs), spacing)
        ahead = random.normal(size=len(polynomial.exponents))
        c, x, r, q = samples_one_by_one(
            printed, polynomial, model.states, matrices, limits, ahead, kappa, spacing
        )
        found = model.equations(slice(0, len(model)), ahead, kappa, 0.5)
        matrix, vector = x.T @ (c[:, None] * x), x.T @ (c * r)
        np.testing.assert_allclose(found.matrix, matrix, rtol=1e-8, atol=1e-9 * matrix.max())
        np.testing.assert_allclose(found.vector, vector, rtol=1e-8, atol=1e-9 * abs(vector).max())
        assert found.offset == pytest.approx(c @ r**2, rel=1e-9)
        assert found.running_cost == pytest.approx(c @ q**2, rel=1e-9)


@settings(max_examples=30)
@given(seed=seeds, kappa=st.floats(-3.0, 3.0), cuts=st.sets(st.integers(1, 159), max_size=6))
def test_parts_of_the_samples_add_up_to_the_whole(seed, kappa, cuts):
    model = KnotModel(tuning(degree=4, limits=ROBOT), 0.2)
    ahead = np.random.default_rng(seed).normal(size=31)
    edges = [0, *sorted(cuts), len(model)]
    parts = [
        model.equations(slice(start, stop), ahead, kappa, 0.5)
        for start, stop in itertools.pairwise(edges)
    ]
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    whole = model.equations(slice(0, len(model)), ahead, kappa, 0.5)
    np.testing.assert_allclose(total.matrix, whole.matrix, atol=1e-10 * whole.matrix.max())
    np.testing.assert_allclose(total.vector, whole.vector, atol=1e-10 * abs(whole.vector).max())
    assert total.offset == pytest.approx(whole.offset, rel=1e-10)
    assert total.running_cost == pytest.approx(whole.running_cost, rel=1e-10)


# --- the solution -------------------------------------------------------------------------------


@pytest.mark.parametrize("limits", [UNLIMITED, ROBOT], ids=["free", "robot"])
@pytest.mark.parametrize(
    ("degree", "frame"), [(2, "half_angle"), (4, "half_angle"), (3, "serret_frenet")]
)
@pytest.mark.parametrize("kappa", [0.0, 0.9])
def test_the_fit_has_the_least_bellman_errors(printed, explicit, limits, degree, frame, kappa):
    model = KnotModel(tuning(degree, frame, limits), 0.2)
    polynomial = explicit(degree, frame)
    ahead = np.zeros(len(polynomial.exponents))
    ahead[:6] = (0.9, 0.0, 0.0, 2.8, 2.0, 1.4)
    matrices = (np.eye(3), np.eye(2))
    c, x, r, q = samples_one_by_one(
        printed, polynomial, model.states, matrices, limits, ahead, kappa, 0.2
    )
    root = np.sqrt(c)
    best = np.linalg.lstsq(root[:, None] * x, -root * r, rcond=None)[0]
    found = fit(model.equations(slice(0, len(model)), ahead, kappa, 0.5))
    np.testing.assert_allclose(found.critic_weights, best, rtol=1e-4, atol=1e-4)
    least = c @ (r + x @ best) ** 2
    reached = c @ (r + x @ found.critic_weights) ** 2
    assert reached <= least * (1.0 + 1e-6)
    assert found.residual == pytest.approx(math.sqrt(reached / (c @ q**2)), rel=1e-4)


@pytest.mark.parametrize("degree", range(2, 9))
def test_the_excitation_certificate_bounds_the_smallest_singular_value(degree):
    model = KnotModel(tuning(degree, sample_count=512), 0.2)
    ahead = np.zeros(math.comb(degree + 3, 3) - 4)
    ahead[:6] = (0.9, 0.0, 0.0, 2.8, 2.0, 1.4)
    for kappa in (-0.5, 0.0, 1.2):
        equations = model.equations(slice(0, len(model)), ahead, kappa, 0.5)
        scale = np.sqrt(np.diag(equations.matrix))
        scaled = equations.matrix / scale[:, None] / scale
        smallest = float(np.linalg.svd(scaled, compute_uv=False)[-1])
        found = fit(equations)
        assert 0.01 * smallest < found.excitation <= smallest + 1e-9
        assert found.residual < 0.5


def random_equations(seed, size, rows):
    """Return regressors and constants with the normal equations of their squares' sum."""
    random = np.random.default_rng(seed)
    regressor = random.normal(size=(rows, size)) * 10.0 ** random.uniform(-3.0, 3.0, size)
    constant = random.normal(size=rows)
    cost = float(constant @ constant)
    vector = regressor.T @ constant
    return regressor, constant, NormalEquations(regressor.T @ regressor, vector, cost, cost)


@settings(max_examples=100)
@given(seed=seeds, size=st.integers(1, 12), more=st.integers(5, 30))
def test_the_fit_of_any_equations_is_their_least_squares_solution(seed, size, more):
    regressor, constant, equations = random_equations(seed, size, size + more)
    best = np.linalg.lstsq(regressor, -constant, rcond=None)[0]
    found = fit(equations)
    scale = np.linalg.norm(regressor, axis=0)
    np.testing.assert_allclose(found.critic_weights * scale, best * scale, atol=1e-5)
    left = np.linalg.norm(constant + regressor @ best) / np.linalg.norm(constant)
    assert found.residual == pytest.approx(left, rel=1e-5)


def smallest_eigenvalue(equations):
    """Return that of the matrix scaled to a unit diagonal."""
    scale = np.sqrt(np.diag(equations.matrix))
    return float(np.linalg.eigvalsh(equations.matrix / scale[:, None] / scale)[0])


@settings(max_examples=100)
@given(seed=seeds, size=st.integers(1, 12), more=st.integers(0, 30))
def test_the_certificate_of_any_equations_has_the_size_of_the_bound(seed, size, more):
    _, _, equations = random_equations(seed, size, size + more)
    smallest, found = smallest_eigenvalue(equations), fit(equations).excitation
    assert 0.9 * smallest / math.sqrt(size) <= found <= 20.0 * smallest + 1e-8


def test_the_certificate_of_any_equations_is_a_fair_estimate():
    for seed in range(200):
        _, _, equations = random_equations(seed, 8, 20)
        smallest = smallest_eigenvalue(equations)
        assert smallest / 8.0 - 2e-9 <= fit(equations).excitation <= 5.0 * smallest + 2e-9


@settings(max_examples=50)
@given(seed=seeds, size=st.integers(2, 12))
def test_samples_that_do_not_determine_the_weights_certify_nothing(seed, size):
    _, _, equations = random_equations(seed, size, size - 1)
    assert fit(equations).excitation < 1e-8


@pytest.mark.parametrize("bad", [math.nan, -1.0])
def test_equations_without_a_solution_give_no_weights(bad):
    matrix = np.eye(4)
    matrix[1, 1] = bad
    found = fit(NormalEquations(matrix, np.ones(4), 1.0, 1.0))
    assert not np.isfinite(found.critic_weights).any()
    assert found.excitation == 0.0
    assert found.residual == math.inf
