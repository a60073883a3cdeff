"""Values and gradients of the value function's bases against explicit formulas."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from adp_path_follower.core.basis import BASES, QuadraticBasis, make_basis

EXPLICIT = {
    "paper": lambda a, b, c, d: [a * b, a * c, a * d, b * c, b * d, c * d, a * a, b * b, c * c],
    "paper_misprinted": lambda a, b, c, d: [a * b, a * c, a * d, b * c, b * d, c * d, a, b, c],
}
LABELS = {
    "paper": ["s y", "s θ", "s φ", "y θ", "y φ", "θ φ", "s²", "y²", "θ²"],
    "paper_misprinted": ["s y", "s θ", "s φ", "y θ", "y φ", "θ φ", "s", "y", "θ"],
}
names = st.sampled_from(sorted(EXPLICIT))
states = npst.arrays(float, 4, elements=st.floats(-10.0, 10.0))


def test_there_is_a_formula_here_for_every_basis():
    assert {*EXPLICIT, "polynomial"} == set(BASES)


@pytest.mark.parametrize("name", sorted(EXPLICIT))
def test_labels_name_the_terms_in_order(name):
    assert list(make_basis(name, 2, "serret_frenet").labels) == LABELS[name]


@settings(max_examples=100, deadline=None)
@given(name=names, zeta=states)
def test_values_are_the_explicit_terms_in_order(name, zeta):
    np.testing.assert_allclose(
        make_basis(name, 2, "serret_frenet").value(zeta), EXPLICIT[name](*zeta), atol=1e-12
    )


@settings(max_examples=100, deadline=None)
@given(name=names, zeta=states)
def test_gradients_are_central_differences_of_the_explicit_terms(name, zeta):
    gradient = make_basis(name, 2, "serret_frenet").gradient(zeta)
    assert gradient.shape == (9, 4)
    h = 1e-3
    for axis in range(4):
        step = h * np.eye(4)[axis]
        ahead, behind = (np.array(EXPLICIT[name](*(zeta + d))) for d in (step, -step))
        np.testing.assert_allclose(gradient[:, axis], (ahead - behind) / (2.0 * h), atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(name=names, zeta=npst.arrays(float, (2, 3, 4), elements=st.floats(-10.0, 10.0)))
def test_a_batch_of_states_is_as_single_ones(name, zeta):
    basis = make_basis(name, 2, "serret_frenet")
    values, gradients = basis.value(zeta), basis.gradient(zeta)
    assert values.shape == (2, 3, 9)
    assert gradients.shape == (2, 3, 9, 4)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(values[index], basis.value(zeta[index]), atol=1e-12)
        np.testing.assert_allclose(gradients[index], basis.gradient(zeta[index]), atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(zeta=states)
def test_any_products_and_singles_make_a_basis(zeta):
    basis = QuadraticBasis(products=((3, 3), (2, 0)), singles=(3, 1))
    assert basis.labels == ("φ²", "θ s", "φ", "y")
    s, y, theta, phi = zeta
    np.testing.assert_allclose(basis.value(zeta), [phi * phi, theta * s, phi, y], atol=1e-12)
    expected = [[0, 0, 0, 2 * phi], [theta, 0, s, 0], [0, 0, 0, 1], [0, 1, 0, 0]]
    np.testing.assert_allclose(basis.gradient(zeta), expected, atol=1e-12)


@pytest.mark.parametrize("name", sorted(EXPLICIT))
def test_only_the_misprinted_basis_pushes_a_robot_that_is_on_the_path(name):
    gradient = make_basis(name, 2, "serret_frenet").gradient(np.array([0.0, 0.0, 0.0, 0.3]))
    weights = np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.5, 0.0, 1.0])
    pushed = -0.5 * weights @ gradient[:, [0, 2]]  # g at theta = 0 takes the columns s and theta
    expected = [0.0, 0.0] if name == "paper" else [-0.25, -0.5]
    np.testing.assert_allclose(pushed, expected, atol=1e-15)
