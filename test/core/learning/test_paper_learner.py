"""One set of weights for the whole path: least squares, the actor's lag, starts, handing over."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from steady import steady_schedule

from adp_path_follower.core.control.riccati import riccati_solution
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import pose_in_frame
from adp_path_follower.core.learning.bellman import Observation, bellman_errors
from adp_path_follower.core.learning.paper_learner import PathStateLearner
from adp_path_follower.core.learning.update_laws import follow, least_squares
from adp_path_follower.core.learning.weights import Weights, initial_weights
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.settings.groups import (
    CostSettings,
    LearningSettings,
    Settings,
    TargetSettings,
)
from adp_path_follower.core.settings.schema import build

SIZE = 9
EIGHT = lissajous()
SCHEDULE = steady_schedule(EIGHT, TargetSettings(), CostSettings())
seeds = st.integers(0, 2**32 - 1)
weights = npst.arrays(float, SIZE, elements=st.floats(-5.0, 5.0))
UNMEASURED = Observation(np.zeros(()), lambda: pytest.fail("measured"))
PAPER = {"basis": "paper", "scheduling": "path_state", "frame": "serret_frenet"}


def learner_of(values, start=None):
    return PathStateLearner(build(Settings, values), SCHEDULE, start)


def samples(seed, count):
    """Return regressors and running costs of samples."""
    random = np.random.default_rng(seed)
    return random.normal(size=(count, SIZE)), random.uniform(0.0, 2.0, count)


# --- least squares ------------------------------------------------------------------------------


@settings(max_examples=60)
@given(seed=seeds, count=st.integers(SIZE + 5, 40), critic=weights, actor=weights)
def test_least_squares_weigh_each_sample_by_its_normalisation(seed, count, critic, actor):
    regressor, costs = samples(seed, count)
    found = least_squares(Weights(critic, actor), bellman_errors(critic, regressor, costs))
    root = 1.0 / np.sqrt(1.0 + (regressor**2).sum(axis=1))
    best = np.linalg.lstsq(regressor * root[:, None], -costs * root, rcond=None)[0]
    np.testing.assert_allclose(found, best, rtol=1e-5, atol=1e-5)


@settings(max_examples=30)
@given(seed=seeds, count=st.integers(1, SIZE - 1))
def test_what_the_samples_do_not_determine_stays_small(seed, count):
    regressor, costs = samples(seed, count)
    start = Weights(np.ones(SIZE), np.ones(SIZE))
    found = least_squares(start, bellman_errors(start.critic, regressor, costs))
    np.testing.assert_allclose(regressor @ found, -costs, atol=1e-4)  # no error is left
    # It takes the least of all such weights, measured by how much each regressor says.
    scaled = regressor / np.sqrt(1.0 + (regressor**2).sum(axis=1))[:, None]
    size = np.linalg.norm(scaled, axis=0)
    least = np.linalg.lstsq(regressor / size, -costs, rcond=None)[0]
    assert np.linalg.norm(found * size) <= np.linalg.norm(least) * 1.001 + 1e-6


def test_least_squares_of_a_batch_are_those_of_single_runs():
    random = np.random.default_rng(3)
    regressor, costs = random.normal(size=(2, 3, 20, SIZE)), random.uniform(size=(2, 3, 20))
    critic = random.normal(size=(2, 3, SIZE))
    together = least_squares(Weights(critic, critic), bellman_errors(critic, regressor, costs))
    for i in np.ndindex(2, 3):
        single = bellman_errors(critic[i], regressor[i], costs[i])
        found = least_squares(Weights(critic[i], critic[i]), single)
        np.testing.assert_allclose(together[i], found, rtol=1e-9, atol=1e-12)


# --- the actor ----------------------------------------------------------------------------------


@settings(max_examples=60)
@given(actor=weights, critic=weights, gain=st.floats(0.0, 1e3), dt=st.floats(0.0, 1.0))
def test_the_actor_follows_by_an_exact_lag(actor, critic, gain, dt):
    found = follow(actor, critic, gain, 1e3, dt)
    expected = critic + math.exp(-gain * dt) * (actor - critic)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    half = follow(actor, critic, gain, 1e3, 0.5 * dt)
    np.testing.assert_allclose(follow(half, critic, gain, 1e3, 0.5 * dt), found, atol=1e-12)


@settings(max_examples=60)
@given(
    actor=npst.arrays(float, (3, SIZE), elements=st.floats(-1e3, 1e3)),
    critic=npst.arrays(float, (3, SIZE), elements=st.floats(-1e3, 1e3)),
    bound=st.floats(0.1, 10.0),
)
def test_the_actor_never_leaves_its_bound_and_each_of_a_batch_has_its_own(actor, critic, bound):
    together = follow(actor, critic, 50.0, bound, 0.1)
    assert (np.linalg.norm(together, axis=1) <= 1.1 * bound * (1.0 + 1e-12)).all()
    for index in range(3):
        single = follow(actor[index], critic[index], 50.0, bound, 0.1)
        np.testing.assert_allclose(together[index], single, rtol=1e-12, atol=1e-12)


# --- starts -------------------------------------------------------------------------------------


@pytest.mark.parametrize("frame", ["serret_frenet", "half_angle"])
@pytest.mark.parametrize("basis", ["paper", "polynomial"])
def test_riccati_starts_have_the_value_of_the_solution(basis, frame):
    scheduling = "path_state" if basis == "paper" else "arc_length"
    learning = LearningSettings(basis=basis, frame=frame, scheduling=scheduling)
    curvature = np.array([[-0.6, 0.0], [0.3, 1.1]])
    found = initial_weights(learning, SCHEDULE, curvature, 0.5)
    assert found.actor.tolist() == found.critic.tolist()
    assert found.actor is not found.critic  # one learns without the other
    error = 1e-4 * np.array([1.0, -2.0, 0.5, 0.0])
    for index in np.ndindex(2, 2):
        p = riccati_solution(float(curvature[index]), 0.5, TargetSettings(), CostSettings())
        value = learning.value_basis.value(error) @ found.critic[index]
        assert value == pytest.approx(error[:3] @ p @ error[:3], rel=1e-3)


@pytest.mark.parametrize("given_size", [6, 31])
def test_listed_starts_are_filled_up_with_zeros(given_size):
    critic = tuple(float(value) for value in range(1, given_size + 1))
    learning = LearningSettings(
        basis_degree=4,
        initial_weights="listed",
        initial_critic_weights=critic,
        initial_actor_weights=critic[::-1],
    )
    found = initial_weights(learning, SCHEDULE, np.zeros((2, 3)), 0.5)
    rest = [0.0] * (31 - given_size)
    for index in np.ndindex(2, 3):
        assert found.critic[index].tolist() == [*critic, *rest]
        assert found.actor[index].tolist() == [*critic[::-1], *rest]
    found.critic[0, 0] = -1.0  # places do not share their weights
    assert found.critic[1, 1, 0] == 1.0


# --- the learner --------------------------------------------------------------------------------


@pytest.mark.parametrize("basis", ["paper", "polynomial"])
def test_a_least_squares_critic_is_the_best_for_the_actors_policy(basis):
    values = {**PAPER, "basis": basis, "basis_degree": 3, "samples_per_axis": (4, 4, 4, 3)}
    learner = learner_of(values)
    actor = learner.weights.actor
    regressor, normalization = learner.sampled.regressor, learner.sampled.normalization
    spent = learner.sampled.error - regressor @ learner.weights.critic
    learner.learn(UNMEASURED, 0.02)
    best = np.linalg.lstsq(regressor / normalization[:, None], -spent / normalization, rcond=None)
    np.testing.assert_allclose(learner.weights.critic, best[0], rtol=1e-4, atol=1e-4)
    lagged = best[0] + math.exp(-50.0 * 0.02) * (actor - best[0])
    np.testing.assert_allclose(learner.weights.actor, lagged, rtol=1e-4, atol=1e-4)


def test_settled_least_squares_stand_still():
    values = {**PAPER, "basis": "polynomial", "basis_degree": 4, "samples_per_axis": (5, 5, 5, 3)}
    follower = PathFollower(build(Settings, values), EIGHT, 5.0)
    pose = pose_in_frame(np.array([0.1, 0.2, -0.1]), EIGHT.frame(5.0).pose)
    assert follower.learn_at_rest(pose)
    before = follower.weights
    follower.step(pose, 0.0)
    follower.step(pose, 0.05)
    np.testing.assert_allclose(follower.weights.critic, before.critic, atol=1e-6)
    np.testing.assert_allclose(follower.weights.actor, before.actor, atol=1e-6)
    np.testing.assert_allclose(before.actor, before.critic, atol=1e-6)


@pytest.mark.parametrize("critic", ["gradient", "least_squares"])
def test_no_time_changes_nothing(critic):
    learner = learner_of({**PAPER, "critic": critic})
    before = learner.weights
    for dt in (0.0, -0.01):
        learner.learn(UNMEASURED, dt)
    assert learner.weights is before


def test_the_samples_are_those_of_the_present_weights():
    learner = learner_of({**PAPER, "critic": "least_squares"})
    before = learner.sampled
    assert learner.sampled is before  # computed once
    learner.learn(UNMEASURED, 0.02)
    after = learner.sampled
    assert after.error.tolist() != before.error.tolist()
    fresh = learner_of({**PAPER, "critic": "least_squares"}, learner.weights)
    np.testing.assert_allclose(after.error, fresh.sampled.error, rtol=1e-12)


def test_weights_are_the_same_everywhere():
    learner = learner_of(PAPER)
    local = learner.local(np.array([0.0, 50.0]))
    assert local is learner.weights
    assert local.slope is None
    assert learner.problem == ""


def test_a_reset_returns_single_runs_of_a_batch_to_the_start():
    start = Weights(np.ones((3, SIZE)), np.full((3, SIZE), 2.0))
    learner = learner_of(PAPER, start)
    learner.reset(np.array([True, False, True]))
    first = initial_weights(build(Settings, PAPER).learning, SCHEDULE, np.zeros(()), 0.5)
    assert learner.weights.critic.tolist() == [
        *[first.critic.tolist()],
        [1.0] * SIZE,
        first.critic.tolist(),
    ]
    assert learner.weights.actor[1].tolist() == [2.0] * SIZE
    learner.reset()
    assert learner.weights.critic.tolist() == first.critic.tolist()


def test_weights_are_taken_over_by_another_problem_but_not_by_another_basis():
    before = learner_of(PAPER, Weights(np.ones(SIZE), np.ones(SIZE)))
    for changes, kept in (
        ({"desired_speed": 0.8, "state_cost": (2.0, 1.0, 1.0)}, True),
        ({"critic": "gradient"}, True),
        ({"basis": "paper_misprinted"}, False),
        ({"frame": "half_angle"}, False),
        ({"basis": "polynomial"}, False),
    ):
        after = learner_of({**PAPER, **changes})
        start = after.weights
        after.take_over(before)
        assert after.weights is (before.weights if kept else start)
