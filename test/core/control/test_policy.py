"""The policy against the minimum of the Hamiltonian that it stands for."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.optimize import minimize

from adp_path_follower.core.control.policy import actor_input, saturate
from adp_path_follower.core.settings.groups import LimitSettings

slopes = npst.arrays(float, (9, 2), elements=st.floats(-2.0, 2.0))
weights = npst.arrays(float, 9, elements=st.floats(-2.0, 2.0))
costs = st.floats(0.1, 10.0)
limits = st.builds(
    LimitSettings,
    min_linear_vel=st.floats(-1.0, 0.0),
    max_linear_vel=st.floats(0.01, 2.0),
    max_angular_vel=st.floats(0.01, 2.0),
)
steady_inputs = st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)).map(np.array)


@settings(max_examples=80)
@given(actor=weights, slope=slopes, first=costs, second=costs, coupling=st.floats(-0.9, 0.9))
def test_the_policy_makes_the_hamiltonian_stationary(actor, slope, first, second, coupling):
    mixed = coupling * math.sqrt(first * second)
    input_cost = np.array([[first, mixed], [mixed, second]])
    found = actor_input(actor, slope, np.linalg.inv(input_cost))
    np.testing.assert_allclose(2.0 * input_cost @ found + slope.T @ actor, 0.0, atol=1e-9)


@settings(max_examples=60)
@given(actor=weights, slope=slopes, first=costs, second=costs, box=limits, steady=steady_inputs)
def test_the_clipped_policy_minimises_the_hamiltonian_over_the_box(
    actor, slope, first, second, box, steady
):
    input_cost = np.diag([first, second])
    linear = slope.T @ actor

    def hamiltonian(u):
        return u @ input_cost @ u + linear @ u

    wanted = actor_input(actor, slope, np.linalg.inv(input_cost))
    found = saturate(wanted, steady, box)
    bounds = [
        (box.min_linear_vel - steady[0], box.max_linear_vel - steady[0]),
        (-box.max_angular_vel - steady[1], box.max_angular_vel - steady[1]),
    ]
    for value, (low, high) in zip(found, bounds, strict=True):
        assert low - 1e-12 <= value <= high + 1e-12
    best = minimize(
        hamiltonian,
        np.mean(bounds, axis=1),
        jac=lambda u: 2.0 * input_cost @ u + linear,
        bounds=bounds,
        method="L-BFGS-B",
    )
    assert hamiltonian(found) <= best.fun + 1e-9


@settings(max_examples=40)
@given(
    wanted=npst.arrays(float, (2, 3, 2), elements=st.floats(-5.0, 5.0)),
    steady=npst.arrays(float, (2, 3, 2), elements=st.floats(-2.0, 2.0)),
    box=limits,
)
def test_a_batch_is_clipped_as_single_inputs_are(wanted, steady, box):
    together = saturate(wanted, steady, box)
    for index in np.ndindex(2, 3):
        v = min(max(wanted[index][0] + steady[index][0], box.min_linear_vel), box.max_linear_vel)
        bound = box.max_angular_vel
        w = min(max(wanted[index][1] + steady[index][1], -bound), bound)
        np.testing.assert_allclose(together[index] + steady[index], [v, w], atol=1e-14)


@settings(max_examples=40)
@given(wanted=npst.arrays(float, 2, elements=st.floats(-1e6, 1e6)), steady=steady_inputs)
def test_without_limits_no_input_is_clipped(wanted, steady):
    unlimited = LimitSettings(-math.inf, math.inf, math.inf)
    assert saturate(wanted, steady, unlimited).tolist() == wanted.tolist()
    one_sided = LimitSettings(-math.inf, math.inf, 1.0)
    assert saturate(wanted, steady, one_sided)[0] == pytest.approx(wanted[0], abs=1e-9)
