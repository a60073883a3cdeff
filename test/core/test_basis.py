"""Values and gradients of the value function's bases against explicit formulas."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from adp_path_follower.core.basis import (
    BASES,
    FRAMES,
    HalfAngleBasis,
    MonomialBasis,
    PolynomialBasis,
    make_basis,
)

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
near_states = npst.arrays(float, 4, elements=st.floats(-2.0, 2.0))
degrees = st.integers(2, 8)
frames = st.sampled_from(FRAMES)
matrices = npst.arrays(float, (3, 3), elements=st.floats(-5.0, 5.0)).map(lambda root: root + root.T)


def test_there_is_a_formula_here_for_every_basis():
    assert {*EXPLICIT, "polynomial"} == set(BASES)


@pytest.mark.parametrize("name", sorted(EXPLICIT))
def test_labels_name_the_terms_in_order(name):
    assert list(make_basis(name, 2, "serret_frenet").labels) == LABELS[name]


@settings(max_examples=100)
@given(name=names, zeta=states)
def test_values_are_the_explicit_terms_in_order(name, zeta):
    np.testing.assert_allclose(
        make_basis(name, 2, "serret_frenet").value(zeta), EXPLICIT[name](*zeta), atol=1e-12
    )


@settings(max_examples=100)
@given(name=names, zeta=states)
def test_gradients_are_central_differences_of_the_explicit_terms(name, zeta):
    gradient = make_basis(name, 2, "serret_frenet").gradient(zeta)
    assert gradient.shape == (9, 4)
    h = 1e-3
    for axis in range(4):
        step = h * np.eye(4)[axis]
        ahead, behind = (np.array(EXPLICIT[name](*(zeta + d))) for d in (step, -step))
        np.testing.assert_allclose(gradient[:, axis], (ahead - behind) / (2.0 * h), atol=1e-9)


@settings(max_examples=60)
@given(name=names, zeta=npst.arrays(float, (2, 3, 4), elements=st.floats(-10.0, 10.0)))
def test_a_batch_of_states_is_as_single_ones(name, zeta):
    basis = make_basis(name, 2, "serret_frenet")
    values, gradients = basis.value(zeta), basis.gradient(zeta)
    assert values.shape == (2, 3, 9)
    assert gradients.shape == (2, 3, 9, 4)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(values[index], basis.value(zeta[index]), atol=1e-12)
        np.testing.assert_allclose(gradients[index], basis.gradient(zeta[index]), atol=1e-12)


@settings(max_examples=60)
@given(zeta=states)
def test_any_powers_make_a_basis(zeta):
    basis = MonomialBasis([(0, 0, 0, 2), (1, 0, 1, 0), (0, 0, 0, 1), (0, 1, 0, 0)])
    assert basis.labels == ("φ²", "s θ", "φ", "y")
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


# --- all monomials up to a degree ---------------------------------------------------------------


@pytest.mark.parametrize("degree", range(2, 9))
def test_a_polynomial_has_every_monomial_from_degree_two_once(degree):
    basis = PolynomialBasis(degree)
    assert len(basis.labels) == math.comb(degree + 3, 3) - 4
    assert len(set(basis.labels)) == len(basis.labels)
    assert basis.value(np.zeros(4)).shape == (len(basis.labels),)
    assert basis.labels[:6] == ("s²", "s y", "s θ", "y²", "y θ", "θ²")
    shorter = PolynomialBasis(max(2, degree - 1)).labels
    assert basis.labels[: len(shorter)] == shorter


def power_of(label, letter):
    """Return the power of a letter in a label."""
    powers = [part[1:] or "¹" for part in label.split() if part[0] == letter]
    return "¹²³⁴⁵⁶⁷⁸".index(powers[0]) + 1 if powers else 0


def value_of_label(label, values):
    """Return what a label such as "a² θ" says, for the values of its letters."""
    return math.prod(value ** power_of(label, letter) for letter, value in values.items())


@settings(max_examples=60)
@given(degree=degrees, frame=frames, zeta=near_states)
def test_labels_say_what_the_terms_of_a_polynomial_are(degree, frame, zeta):
    basis = make_basis("polynomial", degree, frame)
    s, y, theta, _ = zeta
    values = {"s": s, "y": y, "θ": theta}
    if frame == "half_angle":
        turned = complex(s, y) * complex(math.cos(0.5 * theta), -math.sin(0.5 * theta))
        values = {"a": turned.real, "b": turned.imag, "θ": theta}
    expected = [value_of_label(label, values) for label in basis.labels]
    np.testing.assert_allclose(basis.value(zeta), expected, rtol=1e-11, atol=1e-11)


@settings(max_examples=60)
@given(degree=degrees, frame=frames, zeta=near_states)
def test_polynomials_and_their_gradients_are_the_explicit_ones(explicit, degree, frame, zeta):
    basis, reference = make_basis("polynomial", degree, frame), explicit(degree, frame)
    value, gradient = basis.value(zeta), basis.gradient(zeta)
    np.testing.assert_allclose(value, reference.value(zeta[:3]).real, rtol=1e-11, atol=1e-11)
    assert gradient.shape == (*value.shape, 4)
    expected = reference.gradient(zeta[:3])
    np.testing.assert_allclose(gradient[:, :3], expected, rtol=1e-10, atol=1e-10)
    assert (gradient[:, 3] == 0.0).all()


@settings(max_examples=60)
@given(degree=degrees, frame=frames, name=st.sampled_from(BASES), zeta=near_states)
def test_gradients_are_central_differences_of_the_values(degree, frame, name, zeta):
    basis = make_basis(name, degree, frame)
    gradient = basis.gradient(zeta)
    h = 1e-5
    for axis in range(4):
        step = h * np.eye(4)[axis]
        found = (basis.value(zeta + step) - basis.value(zeta - step)) / (2.0 * h)
        np.testing.assert_allclose(gradient[:, axis], found, rtol=1e-6, atol=1e-6)


@settings(max_examples=30)
@given(
    degree=degrees,
    frame=frames,
    name=st.sampled_from(BASES),
    zeta=npst.arrays(float, (2, 3, 4), elements=st.floats(-2.0, 2.0)),
)
def test_a_batch_of_states_is_as_single_ones_in_every_frame(degree, frame, name, zeta):
    basis = make_basis(name, degree, frame)
    given_states = zeta.copy()
    values, gradients = basis.value(zeta), basis.gradient(zeta)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(values[index], basis.value(zeta[index]), rtol=1e-12)
        np.testing.assert_allclose(gradients[index], basis.gradient(zeta[index]), rtol=1e-12)
    assert zeta.tobytes() == given_states.tobytes()


# --- the half-angle frame -----------------------------------------------------------------------


@settings(max_examples=60)
@given(name=st.sampled_from(BASES), degree=degrees, zeta=near_states)
def test_half_angle_values_are_those_of_the_basis_at_turned_positions(name, degree, zeta):
    inner = make_basis(name, degree, "serret_frenet")
    s, y, theta, phi = zeta
    turned = complex(s, y) * complex(math.cos(0.5 * theta), -math.sin(0.5 * theta))
    expected = inner.value(np.array([turned.real, turned.imag, theta, phi]))
    basis = HalfAngleBasis(inner)
    np.testing.assert_allclose(basis.value(zeta), expected, rtol=1e-12, atol=1e-12)
    assert basis.depends_on_path_state is inner.depends_on_path_state


@settings(max_examples=60)
@given(degree=degrees, zeta=near_states)
def test_half_angle_values_have_the_mirror_symmetry_of_the_problem(degree, zeta):
    basis = make_basis("polynomial", degree, "half_angle")
    signs = [(-1.0) ** (power_of(label, "b") + power_of(label, "θ")) for label in basis.labels]
    mirrored = zeta * [1.0, -1.0, -1.0, 1.0]
    np.testing.assert_allclose(basis.value(mirrored), signs * basis.value(zeta), atol=1e-12)


@pytest.mark.parametrize("frame", FRAMES)
def test_bases_say_whether_they_know_the_path_state(frame):
    assert not make_basis("polynomial", 4, frame).depends_on_path_state
    assert make_basis("paper", 2, frame).depends_on_path_state
    assert make_basis("paper_misprinted", 2, frame).depends_on_path_state
    assert not MonomialBasis([(1, 1, 0), (0, 0, 2)]).depends_on_path_state
    assert MonomialBasis([(1, 1, 0, 0), (0, 0, 0, 1)]).depends_on_path_state


# --- weights of a quadratic form ----------------------------------------------------------------


@settings(max_examples=60)
@given(
    name=st.sampled_from(["paper", "polynomial"]), degree=degrees, matrix=matrices, zeta=near_states
)
def test_quadratic_weights_give_the_quadratic_form(name, degree, matrix, zeta):
    basis = make_basis(name, degree, "serret_frenet")
    error = zeta[:3]
    found = basis.value(zeta) @ basis.quadratic_weights(matrix)
    assert found == pytest.approx(error @ matrix @ error, rel=1e-12, abs=1e-10)


@settings(max_examples=60)
@given(
    name=st.sampled_from(["paper", "polynomial"]), degree=degrees, matrix=matrices, zeta=near_states
)
def test_in_the_half_angle_frame_they_give_it_to_second_order(name, degree, matrix, zeta):
    basis = make_basis(name, degree, "half_angle")
    weights = basis.quadratic_weights(matrix)
    for scale in (1e-1, 1e-2, 1e-3):
        small = scale * zeta
        form = small[:3] @ matrix @ small[:3]
        # The turn changes the position by |theta| |position| / 2, so the miss is of third order.
        assert abs(basis.value(small) @ weights - form) <= 500.0 * scale**3 + 1e-18


@settings(max_examples=20)
@given(frame=frames, several=npst.arrays(float, (2, 5, 3, 3), elements=st.floats(-5.0, 5.0)))
def test_quadratic_weights_of_a_batch_are_those_of_single_ones(frame, several):
    for name in ("paper", "polynomial"):
        basis = make_basis(name, 3, frame)
        together = basis.quadratic_weights(several)
        for index in np.ndindex(2, 5):
            single = basis.quadratic_weights(several[index])
            assert together[index].tolist() == single.tolist()


@settings(max_examples=60)
@given(
    degree=degrees,
    frame=frames,
    name=st.sampled_from(BASES),
    several=npst.arrays(float, (3, 4), elements=st.floats(-2.0, 2.0)),
    seed=st.integers(0, 2**32 - 1),
)
def test_products_with_the_gradient_are_those_of_the_gradient_written_out(
    degree, frame, name, several, seed
):
    basis = make_basis(name, degree, frame)
    random = np.random.default_rng(seed)
    weights, rates = random.normal(size=(3, len(basis.labels))), random.normal(size=(3, 4))
    gradient = basis.gradient(several)
    slope = np.einsum("nlz,nl->nz", gradient, weights)
    change = np.einsum("nlz,nz->nl", gradient, rates)
    scale = 1e-12 * (1.0 + np.abs(gradient).max() * np.abs(weights).max()) * weights.shape[1]
    batch = basis.expansion(several)
    np.testing.assert_allclose(np.stack(batch.slope(weights), -1), slope, atol=scale)
    np.testing.assert_allclose(batch.rate(tuple(rates.T)), change, atol=scale)
    for index, zeta in enumerate(several):
        single = basis.expansion(zeta)
        np.testing.assert_allclose(single.slope(weights[index]), slope[index], atol=scale)
        np.testing.assert_allclose(single.rate(tuple(rates[index])), change[index], atol=scale)
