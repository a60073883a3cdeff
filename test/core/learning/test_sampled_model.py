"""Bellman errors against plain loops over the printed formulas."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from steady import steady_reference

from adp_path_follower.core.learning.bellman import bellman_errors, excitation
from adp_path_follower.core.learning.paper_learner import SampledModel
from adp_path_follower.core.learning.samples import sample_grid
from adp_path_follower.core.path.library import circle, lissajous
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

PATHS = {"figure eight": lissajous(), "circle": circle(-0.8)}
weights = npst.arrays(float, 9, elements=st.floats(-3.0, 3.0))


def model_of(tuning, path):
    return SampledModel(tuning, path, steady_reference(path, tuning.target).profile)


@st.composite
def costs(draw, size, margin):
    """Return a symmetric matrix whose eigenvalues are at least the margin, row by row."""
    root = draw(npst.arrays(float, (size, size), elements=st.floats(-1.0, 1.0)))
    matrix = root @ root.T
    matrix = 0.5 * (matrix + matrix.T) + margin * np.eye(size)
    return tuple(matrix.ravel().tolist())


def assert_same(sweep, naive):
    np.testing.assert_allclose(sweep.error, [delta for delta, _, _ in naive], atol=1e-9)
    np.testing.assert_allclose(sweep.regressor, [omega for _, omega, _ in naive], atol=1e-9)
    np.testing.assert_allclose(sweep.normalization, [p for _, _, p in naive], atol=1e-9)
    size = len(naive[0][1])
    information, gradient = np.zeros((size, size)), np.zeros(size)
    for delta, omega, p in naive:
        information += np.outer(omega, omega) / p
        gradient += omega * delta / p
    np.testing.assert_allclose(sweep.information, information, atol=1e-8)
    np.testing.assert_allclose(sweep.gradient, gradient, atol=1e-8)


@settings(max_examples=25)
@given(
    name=st.sampled_from(sorted(PATHS)),
    critic=weights,
    actor=weights,
    state_cost=costs(3, 1e-3),
    input_cost=costs(2, 0.2),
)
def test_sampled_errors_without_limits(printed, paper, name, critic, actor, state_cost, input_cost):
    values = {**paper, "state_cost": state_cost, "input_cost": input_cost}
    model = model_of(build(Settings, values), PATHS[name])
    assert len(model) == 81
    naive = printed.sampled_errors(values, PATHS[name], critic, actor)
    assert_same(model.sweep(critic, actor), naive)


@settings(max_examples=25)
@given(
    name=st.sampled_from(sorted(PATHS)),
    critic=weights,
    actor=weights,
    max_linear_vel=st.sampled_from([0.3, 0.7, math.inf]),
    min_linear_vel=st.sampled_from([-0.2, 0.0, -math.inf]),
    max_angular_vel=st.sampled_from([0.2, 1.0, math.inf]),
    counts=st.tuples(*[st.integers(1, 3)] * 4),
    input_cost=costs(2, 0.2),
)
def test_sampled_errors_of_limited_commands(
    printed,
    paper,
    name,
    critic,
    actor,
    max_linear_vel,
    min_linear_vel,
    max_angular_vel,
    counts,
    input_cost,
):
    values = {
        **paper,
        "max_linear_vel": max_linear_vel,
        "min_linear_vel": min_linear_vel,
        "max_angular_vel": max_angular_vel,
        "samples_per_axis": counts,
        "sample_half_widths": (1.5, 1.0, 0.7, 0.6),
        "input_cost": input_cost,
    }
    model = model_of(build(Settings, values), PATHS[name])
    assert len(model) == math.prod(counts)
    naive = printed.sampled_errors(values, PATHS[name], critic, actor)
    assert_same(model.sweep(critic, actor), naive)


@settings(max_examples=30)
@given(
    half_widths=st.tuples(*[st.floats(0.01, 5.0)] * 4), counts=st.tuples(*[st.integers(1, 4)] * 4)
)
def test_the_grid_is_regular_and_symmetric_about_the_origin(half_widths, counts):
    grid = sample_grid(half_widths, counts)
    assert grid.shape == (math.prod(counts), 4)
    assert len(np.unique(grid, axis=0)) == len(grid)
    mirrored = -grid[::-1]
    np.testing.assert_allclose(grid, mirrored, atol=1e-15)
    for axis, (width, count) in enumerate(zip(half_widths, counts, strict=True)):
        places = np.unique(grid[:, axis])
        assert len(places) == count
        if count > 1:
            assert places[-1] == width
            np.testing.assert_allclose(np.diff(places), 2.0 * width / (count - 1))
        else:
            assert places.tolist() == [0.0]


@settings(max_examples=60)
@given(
    critic=weights,
    zeta=npst.arrays(float, 4, elements=st.floats(-1.0, 1.0)),
    zeta_rate=npst.arrays(float, 4, elements=st.floats(-2.0, 2.0)),
    running_cost=st.floats(0.0, 10.0),
)
def test_a_bellman_error_is_the_formula(printed, critic, zeta, zeta_rate, running_cost):
    sigma = printed.gradient(zeta)
    found = bellman_errors(critic, (sigma @ zeta_rate)[None], np.array([running_cost]))
    assert found.error.shape == (1,)
    assert found.regressor.shape == (1, 9)
    omega = [sum(sigma[row, i] * zeta_rate[i] for i in range(4)) for row in range(9)]
    delta = running_cost + sum(critic[row] * omega[row] for row in range(9))
    p = math.sqrt(1.0 + sum(value**2 for value in omega))
    np.testing.assert_allclose(found.regressor[0], omega, atol=1e-12)
    assert found.error[0] == pytest.approx(delta, abs=1e-12)
    assert found.normalization[0] == pytest.approx(p, rel=1e-14)
    np.testing.assert_allclose(found.gradient, np.array(omega) * delta / p, atol=1e-11)
    np.testing.assert_allclose(found.information, np.outer(omega, omega) / p, atol=1e-11)


@settings(max_examples=25)
@given(
    critic=npst.arrays(float, (2, 3, 9), elements=st.floats(-3.0, 3.0)),
    actor=npst.arrays(float, (2, 3, 9), elements=st.floats(-3.0, 3.0)),
    limited=st.booleans(),
)
def test_a_batch_of_weights_is_as_single_ones(paper, figure_eight, critic, actor, limited):
    limits = {"min_linear_vel": 0.0, "max_linear_vel": 0.8, "max_angular_vel": 0.6}
    values = {**paper, **(limits if limited else {})}
    model = model_of(build(Settings, values), figure_eight)
    together = model.sweep(critic, actor)
    assert together.error.shape == (2, 3, 81)
    certificates = excitation(together.information)
    assert certificates.shape == (2, 3)
    for index in np.ndindex(2, 3):
        single = model.sweep(critic[index], actor[index])
        for name in ("error", "regressor", "normalization", "information", "gradient"):
            expected = getattr(single, name)
            np.testing.assert_allclose(
                getattr(together, name)[index], expected, rtol=1e-12, atol=1e-11
            )
        assert certificates[index] == pytest.approx(
            float(excitation(single.information)), abs=1e-10
        )


@settings(max_examples=60)
@given(
    regressor=npst.arrays(float, (12, 5), elements=st.floats(-3.0, 3.0)),
    critic=npst.arrays(float, 5, elements=st.floats(-3.0, 3.0)),
)
def test_excitation_is_the_smallest_singular_value(regressor, critic):
    errors = bellman_errors(critic, regressor, np.zeros(12))
    matrix = np.zeros((5, 5))
    for omega in regressor:
        matrix += np.outer(omega, omega) / math.sqrt(1.0 + omega @ omega)
    smallest = np.linalg.svd(matrix, compute_uv=False)[-1]
    assert float(excitation(errors.information)) == pytest.approx(smallest, abs=1e-10)


def test_the_papers_grid_determines_every_weight(paper, figure_eight):
    tuning = build(Settings, paper)
    initial = np.array(paper["initial_actor_weights"])
    sweep = model_of(tuning, figure_eight).sweep(initial, initial)
    assert float(excitation(sweep.information)) > 0.1


@pytest.mark.parametrize("counts", [(1, 1, 1, 1), (2, 1, 1, 1), (2, 2, 2, 1), (1, 3, 3, 3)])
def test_samples_that_leave_a_weight_open_do_not_excite(paper, figure_eight, counts):
    tuning = build(Settings, {**paper, "samples_per_axis": counts})
    initial = np.array(paper["initial_actor_weights"])
    sweep = model_of(tuning, figure_eight).sweep(initial, initial)
    assert abs(float(excitation(sweep.information))) < 1e-12
