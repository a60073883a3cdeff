"""The update laws against matrix exponentials and fine integration of the printed laws."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.linalg import expm

from adp_path_follower.core.learning.bellman import BellmanErrors, bellman_errors
from adp_path_follower.core.learning.update_laws import bound_norm, project, relax, update_weights
from adp_path_follower.core.learning.weights import Weights
from adp_path_follower.core.settings.groups import LearningSettings

SIZE = 9
seeds = st.integers(0, 2**32 - 1)
rates = st.one_of(st.just(0.0), st.floats(-6.0, 6.0).map(lambda power: 10.0**power))
periods = st.floats(1e-3, 0.1)
weights = npst.arrays(float, SIZE, elements=st.floats(-5.0, 5.0))


def rotation(seed):
    """Return random orthonormal eigenvectors, as columns."""
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(SIZE, SIZE)))[0]


def learning_settings(**values):
    return LearningSettings(basis="paper", scheduling="path_state", **values)


# --- the critic's step --------------------------------------------------------------------------


@settings(max_examples=150)
@given(eigenvalues=npst.arrays(float, SIZE, elements=rates), seed=seeds, offset=weights, dt=periods)
@example(eigenvalues=np.full(SIZE, 1e6), seed=0, offset=np.ones(SIZE), dt=0.1)
def test_no_direction_overshoots_the_exact_solution(eigenvalues, seed, offset, dt):
    vectors = rotation(seed)
    rate = (vectors * eigenvalues) @ vectors.T
    # In each eigenvector's direction the start is at `offset` and the solution's end at zero.
    step = relax(rate, vectors @ (eigenvalues * offset), dt)
    after = offset - vectors.T @ step
    exact = np.exp(-eigenvalues * dt) * offset
    slack = 1e-5 * (1.0 + np.abs(offset).max())  # of the solve at rate * dt = 1e5
    assert (after >= np.minimum(exact, offset) - slack).all()
    assert (after <= np.maximum(exact, offset) + slack).all()
    z = eigenvalues * dt
    np.testing.assert_allclose(after, offset / (1.0 + z + 0.5 * z * z), atol=slack)


@pytest.mark.parametrize("power", [5, 7, 9, 11])
def test_one_fast_direction_leaves_the_others_alone(power):
    random = np.random.default_rng(power)
    for _ in range(20):
        direction = random.normal(size=SIZE)
        direction /= np.linalg.norm(direction)
        start = random.normal(size=SIZE)
        rate = 10.0**power * np.outer(direction, direction)
        along = direction @ start
        after = start - relax(rate, 10.0**power * along * direction, 0.1)
        assert abs(direction @ after) <= abs(along) * (1.0 + 1e-3) + 1e-3
        others = start - along * direction
        np.testing.assert_allclose(after - (direction @ after) * direction, others, atol=1e-3)


@settings(max_examples=25)
@given(seed=seeds, slowest=st.floats(0.1, 1.0), fastest=st.floats(1.0, 8.0))
def test_steps_are_of_second_order(seed, slowest, fastest):
    vectors = rotation(seed)
    rate = (vectors * np.linspace(slowest, fastest, SIZE)) @ vectors.T
    random = np.random.default_rng(seed)
    start, end = random.normal(size=SIZE), random.normal(size=SIZE)
    exact = end + expm(-rate) @ (start - end)

    def error(count):
        found = start
        for _ in range(count):
            found = found - relax(rate, rate @ (found - end), 1.0 / count)
        return np.linalg.norm(found - exact)

    coarse, fine = error(64), error(128)
    assert 3.3 < coarse / fine < 4.7
    assert fine < 1e-3


@settings(max_examples=30)
@given(eigenvalues=npst.arrays(float, SIZE, elements=rates), seed=seeds, start=weights, dt=periods)
def test_many_steps_stay_stable(eigenvalues, seed, start, dt):
    vectors = rotation(seed)
    rate = (vectors * eigenvalues) @ vectors.T
    found, before = start, np.linalg.norm(start)
    for _ in range(100):
        found = found - relax(rate, rate @ found, dt)
        after = np.linalg.norm(found)
        assert after <= before + 1e-5 * (1.0 + np.linalg.norm(start))
        before = after


@settings(max_examples=30)
@given(descent=weights, dt=periods)
def test_without_a_rate_the_step_is_the_descent_times_the_period(descent, dt):
    np.testing.assert_allclose(relax(np.zeros((SIZE, SIZE)), descent, dt), dt * descent)


@settings(max_examples=20)
@given(seed=seeds, dt=periods)
def test_a_batch_of_steps_is_as_single_ones(seed, dt):
    random = np.random.default_rng(seed)
    roots = random.normal(size=(2, 3, SIZE, SIZE))
    rate = roots @ np.swapaxes(roots, -1, -2)
    descent = random.normal(size=(2, 3, SIZE))
    together = relax(rate, descent, dt)
    for index in np.ndindex(2, 3):
        np.testing.assert_allclose(together[index], relax(rate[index], descent[index], dt))


# --- the projection -----------------------------------------------------------------------------


def of_norm(direction, norm):
    length = np.linalg.norm(direction)
    if length < 1e-3:
        direction, length = np.ones(SIZE), math.sqrt(SIZE)
    return direction * (norm / length)


@settings(max_examples=80)
@given(direction=weights, step=weights, share=st.floats(0.0, 1.0), bound=st.floats(0.1, 100.0))
def test_steps_inside_the_ball_are_not_changed(direction, step, share, bound):
    inside = of_norm(direction, share * bound * (1.0 - 1e-12))
    assert project(step, inside, bound).tolist() == step.tolist()


@settings(max_examples=80)
@given(direction=weights, step=weights, share=st.floats(0.0, 3.0), bound=st.floats(0.1, 100.0))
def test_steps_that_lead_inwards_are_not_changed(direction, step, share, bound):
    anywhere = of_norm(direction, share * bound)
    if anywhere @ step > 0.0:
        step = -step
    np.testing.assert_allclose(project(step, anywhere, bound), step, atol=1e-15)


@settings(max_examples=80)
@given(
    direction=weights,
    step=weights,
    share=st.floats(1.1 + 1e-9, 3.0),
    bound=st.floats(0.1, 100.0),
)
def test_steps_at_the_outer_edge_are_tangential(direction, step, share, bound):
    outside = of_norm(direction, share * bound)
    if outside @ step < 0.0:
        step = -step
    radial = outside / np.linalg.norm(outside)
    found = project(step, outside, bound)
    assert abs(radial @ found) < 1e-9
    np.testing.assert_allclose(found, step - (radial @ step) * radial, atol=1e-9)


@settings(max_examples=80)
@given(direction=weights, step=weights, share=st.floats(1.0, 1.1), bound=st.floats(0.1, 100.0))
def test_steps_fade_out_through_the_layer(direction, step, share, bound):
    between = of_norm(direction, share * bound)
    radial = between / np.linalg.norm(between)
    found = project(step, between, bound)
    outward = max(radial @ step, 0.0)
    assert -1e-9 <= radial @ found - min(radial @ step, 0.0) <= outward + 1e-9
    tangential = step - (radial @ step) * radial
    np.testing.assert_allclose(found - (radial @ found) * radial, tangential, atol=1e-9)


@settings(max_examples=80)
@given(direction=weights, share=st.floats(0.0, 100.0), bound=st.floats(0.1, 100.0))
def test_the_norm_is_bounded_without_turning_the_weights(direction, share, bound):
    given_weights = of_norm(direction, share * bound)
    found = bound_norm(given_weights, bound)
    norm = np.linalg.norm(given_weights)
    assert np.linalg.norm(found) == pytest.approx(min(norm, 1.1 * bound), rel=1e-12)
    np.testing.assert_allclose(found * norm, given_weights * np.linalg.norm(found), atol=1e-9)


# --- the laws -----------------------------------------------------------------------------------


def samples(seed, count, scale=1.0):
    """Return regressors and running costs of samples."""
    random = np.random.default_rng(seed)
    return scale * random.normal(size=(count, SIZE)), random.uniform(0.0, 2.0, count)


def rates_of_the_laws(critic, actor, measured, sampled, learning):
    """Return Wc' and Wa' as they are printed."""
    (near, near_cost), (far, far_cost) = measured, sampled
    critic_rate = np.zeros(SIZE)
    for omega, cost in zip(near, near_cost, strict=True):
        p = math.sqrt(1.0 + omega @ omega)
        critic_rate -= learning.critic_gain_measured * omega * (cost + critic @ omega) / p
    for omega, cost in zip(far, far_cost, strict=True):
        p = math.sqrt(1.0 + omega @ omega)
        share = learning.critic_gain_sampled / len(far)
        critic_rate -= share * omega * (cost + critic @ omega) / p
    actor_rate = -learning.actor_gain * (actor - critic)
    norm, bound = np.linalg.norm(actor), learning.actor_weight_bound
    if norm > bound and actor @ actor_rate > 0.0:
        depth = min((norm**2 - bound**2) / ((1.1 * bound) ** 2 - bound**2), 1.0)
        actor_rate = actor_rate - depth * (actor @ actor_rate) / norm**2 * actor
    return critic_rate, actor_rate


def integrated(start, measured, sampled, learning, duration, count):
    """Return the weights by Runge's and Kutta's method of fourth order."""
    state, h = np.concatenate([start.critic, start.actor]), duration / count

    def rate(values):
        return np.concatenate(
            rates_of_the_laws(values[:SIZE], values[SIZE:], measured, sampled, learning)
        )

    for _ in range(count):
        k1 = rate(state)
        k2 = rate(state + 0.5 * h * k1)
        k3 = rate(state + 0.5 * h * k2)
        k4 = rate(state + h * k3)
        state = state + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
    return Weights(state[:SIZE], state[SIZE:])


def updated(start, measured, sampled, learning, duration, count):
    """Return the weights after so many updates."""
    found = start
    for _ in range(count):
        found = update_weights(
            found,
            bellman_errors(found.critic, *measured),
            bellman_errors(found.critic, *sampled),
            learning,
            duration / count,
        )
    return found


@pytest.mark.parametrize("seed", range(4))
def test_updates_converge_to_the_printed_laws(seed):
    learning = learning_settings(actor_weight_bound=1e3, actor_gain=5.0)
    measured, sampled = samples(seed, 1), samples(seed + 100, 20)
    random = np.random.default_rng(seed)
    start = Weights(random.normal(size=SIZE), random.normal(size=SIZE))
    exact = integrated(start, measured, sampled, learning, 0.5, 400)

    def miss(count):
        found = updated(start, measured, sampled, learning, 0.5, count)
        return (
            np.linalg.norm(found.critic - exact.critic),
            np.linalg.norm(found.actor - exact.actor),
        )

    coarse, fine = miss(200), miss(400)
    assert 3.0 < coarse[0] / fine[0] < 5.0
    assert coarse[1] / fine[1] > 1.7
    assert fine[0] < 1e-3
    assert fine[1] < 0.02


@pytest.mark.parametrize("bound", [0.5, 1.0, 2.0])
def test_updates_under_the_projection_converge_to_the_printed_laws(bound):
    learning = learning_settings(actor_weight_bound=bound, actor_gain=5.0)
    measured, sampled = samples(5, 1), samples(6, 20, 0.7)
    start = Weights(np.full(SIZE, 2.0), np.full(SIZE, 0.1))
    duration = 0.6
    exact = integrated(start, measured, sampled, learning, duration, 600)
    assert np.linalg.norm(exact.actor) > bound  # the projection matters here
    found = updated(start, measured, sampled, learning, duration, 1200)
    np.testing.assert_allclose(found.critic, exact.critic, atol=1e-3)
    np.testing.assert_allclose(found.actor, exact.actor, atol=5e-3)


@settings(max_examples=60)
@given(critic=weights, actor=weights, actor_gain=st.floats(0.0, 1e4), dt=periods)
def test_the_actor_is_an_exact_lag_behind_a_critic_at_rest(critic, actor, actor_gain, dt):
    learning = learning_settings(
        critic_gain_measured=0.0,
        critic_gain_sampled=0.0,
        actor_gain=actor_gain,
        actor_weight_bound=1e6,
    )
    measured, sampled = samples(1, 1), samples(2, 10)
    found = update_weights(
        Weights(critic, actor),
        bellman_errors(critic, *measured),
        bellman_errors(critic, *sampled),
        learning,
        dt,
    )
    np.testing.assert_allclose(found.critic, critic, rtol=0.0, atol=1e-12)
    expected = critic + math.exp(-actor_gain * dt) * (actor - critic)
    np.testing.assert_allclose(found.actor, expected, atol=1e-12)


@settings(max_examples=60)
@given(
    critic=npst.arrays(float, SIZE, elements=st.floats(-1e4, 1e4)),
    actor=npst.arrays(float, SIZE, elements=st.floats(-1e4, 1e4)),
    bound=st.floats(0.01, 100.0),
    actor_gain=st.floats(0.0, 1e4),
    dt=st.floats(1e-3, 1.0),
)
def test_actor_weights_never_leave_the_outer_edge(critic, actor, bound, actor_gain, dt):
    learning = learning_settings(actor_weight_bound=bound, actor_gain=actor_gain)
    found = updated(Weights(critic, actor), samples(3, 1), samples(4, 10), learning, 5 * dt, 5)
    assert np.linalg.norm(found.actor) <= 1.1 * bound * (1.0 + 1e-12)


def test_the_fixed_point_of_the_critic_is_the_weighted_least_squares_solution():
    learning = learning_settings(critic_gain_measured=0.0, actor_weight_bound=1e3)
    regressor, costs = samples(8, 30)
    errors = bellman_errors(np.zeros(SIZE), regressor, costs)
    root = 1.0 / np.sqrt(errors.normalization)
    best = np.linalg.lstsq(regressor * root[:, None], -costs * root, rcond=None)[0]
    nothing = samples(9, 1)
    found = updated(
        Weights(np.zeros(SIZE), np.zeros(SIZE)), nothing, (regressor, costs), learning, 100.0, 1000
    )
    np.testing.assert_allclose(found.critic, best, atol=1e-8)
    np.testing.assert_allclose(found.actor, best, atol=1e-8)


def test_a_batch_of_weights_learns_as_single_ones_do():
    learning = learning_settings()
    random = np.random.default_rng(11)
    critic, actor = random.normal(size=(2, 5, SIZE))
    measured = random.normal(size=(5, 1, SIZE)), random.uniform(0.0, 1.0, (5, 1))
    sampled = random.normal(size=(5, 12, SIZE)), random.uniform(0.0, 1.0, (5, 12))

    def errors(of, index=slice(None)) -> BellmanErrors:
        return bellman_errors(critic[index], of[0][index], of[1][index])

    together = update_weights(
        Weights(critic, actor), errors(measured), errors(sampled), learning, 0.02
    )
    for i in range(5):
        single = update_weights(
            Weights(critic[i], actor[i]), errors(measured, i), errors(sampled, i), learning, 0.02
        )
        np.testing.assert_allclose(together.critic[i], single.critic, rtol=1e-12, atol=1e-13)
        np.testing.assert_allclose(together.actor[i], single.actor, rtol=1e-12, atol=1e-13)
