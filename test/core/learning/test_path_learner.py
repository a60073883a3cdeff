"""Learning along a path: bounded work, one policy at a time, and where it ends."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.control.riccati import RiccatiSchedule, riccati_solution
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import advance_pose, pose_in_frame
from adp_path_follower.core.learning import knot_weights
from adp_path_follower.core.learning.bellman import Observation
from adp_path_follower.core.learning.path_learner import PathLearner
from adp_path_follower.core.path.library import circle, lissajous, named_path
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

PATHS = {"figure eight": lissajous(), "circle": circle(0.5), "line": named_path("line")}
UNLIMITED = {
    "min_linear_vel": -math.inf,
    "max_linear_vel": math.inf,
    "max_angular_vel": math.inf,
}
SMALL = {"basis_degree": 3, "sample_count": 64, "samples_per_step": 64}
LISTED = (0.5, 0.1, 0.2, 0.6, 0.5, 1.0)


def learner_of(path, shape=(), **values):
    tuning = build(Settings, values)
    profile = SpeedProfile(path, tuning)
    riccati = RiccatiSchedule(path, tuning.target, tuning.cost, profile)
    return PathLearner(tuning, riccati, shape)


def riccati_weights(path, place, **values):
    """Return the weights of the Riccati solution at a place of the path."""
    tuning = build(Settings, values)
    speed = tuning.target.desired_speed
    matrix = riccati_solution(float(path.curvature(place)), speed, tuning.target, tuning.cost)
    return tuning.learning.value_basis.quadratic_weights(matrix)


def at(place, distance=0.0):
    """Return an observation at a place; a learner of this kind does not ask for measurements."""
    return Observation(np.asarray(place, float), lambda: pytest.fail("measured"), distance)


def driven(follower, start, error, count, period=0.02):
    """Return the outputs of so many steps from an error at a place."""
    pose = pose_in_frame(np.array(error), follower.path.frame(start).pose)
    outputs = []
    for _ in range(count):
        outputs.append(follower.step(pose, period))
        pose = advance_pose(pose, *outputs[-1].command, period)
    return outputs


class CountingModel:
    """A model that writes down which samples are worked off."""

    def __init__(self, model):
        self._model, self.parts = model, []

    def __len__(self):
        """Return the number of samples."""
        return len(self._model)

    def equations(self, samples, ahead, curvature, v_des):
        """Return what the model gives."""
        self.parts.append((samples.start, samples.stop))
        return self._model.equations(samples, ahead, curvature, v_des)


# --- the work of a step -------------------------------------------------------------------------


@settings(max_examples=25)
@given(
    name=st.sampled_from(sorted(PATHS)),
    count=st.integers(32, 700),
    at_once=st.integers(1, 800),
    place=st.floats(-10.0, 150.0),
)
def test_a_step_works_off_no_more_samples_than_it_may(name, count, at_once, place):
    values = {"basis_degree": 3, "sample_count": count, "samples_per_step": at_once}
    learner = learner_of(PATHS[name], **values)
    counting = learner._model = CountingModel(learner._model)
    done = 0
    for step in range(30):
        learner.learn(at(place + 0.05 * step), 0.01)
        parts, counting.parts = counting.parts, []
        assert sum(stop - start for start, stop in parts) <= at_once
        assert len(parts) <= 1  # none in a rest
        for start, stop in parts:
            # Each sample once, then the next knot; at first, one step's samples make up a knot.
            assert start == done or (start == 0 and done == at_once > 16)
            done = stop % count


def test_rough_weights_come_first_and_those_of_all_samples_later():
    values = {"basis_degree": 3, "sample_count": 256, "preview_distance": 1.0}
    learner = learner_of(PATHS["circle"], **values, samples_per_step=32)
    counting = learner._model = CountingModel(learner._model)
    initial = learner.local(np.asarray(3.0)).critic
    sweeps = [1, 2, 4]  # knots, until the preview of five is reached
    for _ in range(sum(sweeps)):
        learner.learn(at(3.0), 0.01)
    assert counting.parts == [(0, 32)] * sum(sweeps)
    assert learner.local(np.asarray(3.0)).critic.tolist() != initial.tolist()
    counting.parts = []
    for _ in range(16):
        learner.learn(at(3.0), 0.01)
    assert counting.parts == [(start, start + 32) for start in range(0, 256, 32)] * 2


def test_every_sample_counts_once_before_a_knot_has_new_weights():
    learner = learner_of(PATHS["line"], **{**SMALL, "samples_per_step": 10})
    first = learner.local(np.asarray(5.0)).critic
    for _ in range(6):
        learner.learn(at(5.0), 0.01)
        assert learner.local(np.asarray(5.0)).critic.tolist() == first.tolist()
    for _ in range(20):
        learner.learn(at(5.0), 0.01)
    assert learner.local(np.asarray(5.0)).critic.tolist() != first.tolist()


@pytest.mark.parametrize("at_once", [13, 64, 4096])
def test_how_many_samples_a_step_works_off_does_not_change_what_is_learned(at_once):
    found = []
    for samples_per_step in (at_once, 32):
        learner = learner_of(PATHS["circle"], **{**SMALL, "samples_per_step": samples_per_step})
        for _ in range(30 * 12 * max(1, math.ceil(64 / samples_per_step))):
            learner.learn(at(3.0), 0.01)
        found.append(learner.local(np.asarray(3.0)))
    np.testing.assert_allclose(found[0].critic, found[1].critic, atol=1e-6)
    np.testing.assert_allclose(found[0].actor, found[1].actor, atol=1e-6)


@pytest.mark.parametrize("limits", [{}, UNLIMITED], ids=["limited", "free"])
def test_a_command_is_that_of_the_weights_that_are_published_with_it(printed, explicit, limits):
    values = {**limits, "basis_degree": 4, "input_cost": (2.0, 0.5)}
    values |= {"fallback": "none", "wide_region": "none"}
    follower = PathFollower(build(Settings, values), PATHS["figure eight"], 1.0)
    outputs = driven(follower, 1.0, (0.6, -0.9, 0.8), 300, period=0.01)
    polynomial = explicit(4, "half_angle")
    clipped = 0
    for output in outputs:
        gradient = polynomial.gradient(output.error)
        pull = printed.input_matrix([*output.error, 0.0])[:3].T @ gradient.T @ output.weights.actor
        # Commands are held for 10 ms: the curvature is that half way through.
        target_speed = 0.5 * math.cos(output.error[2]) + 0.1 * output.error[0]
        half_way = float(output.arc_length) + 0.005 * target_speed
        steady = np.array([0.5, 0.5 * float(PATHS["figure eight"].curvature(half_way))])
        wanted = steady - 0.5 * pull / [2.0, 0.5]
        lower, upper = (
            ([0.0, -1.5], [1.0, 1.5]) if not limits else ([-math.inf] * 2, [math.inf] * 2)
        )
        np.testing.assert_allclose(output.command, np.clip(wanted, lower, upper), atol=1e-9)
        clipped += (output.command != wanted).any() and bool(not limits)
    assert not limits or clipped == 0
    learned = {output.weights.actor.tobytes() for output in outputs}
    assert len(learned) > 250  # it learned all the while


# --- where it ends ------------------------------------------------------------------------------


def test_on_a_straight_line_the_quadratic_part_is_the_riccati_solution():
    learner = learner_of(PATHS["line"], **UNLIMITED)
    assert learner.settle(at(5.0, 20.0))
    found = learner.local(np.asarray(12.34)).critic[:6]
    expected = riccati_weights(PATHS["line"], 12.34, **UNLIMITED)[:6]
    np.testing.assert_allclose(found, expected, rtol=0.01, atol=0.01 * expected.max())


@pytest.mark.parametrize("curvature", [0.5, -1.0])
def test_on_a_circle_the_quadratic_part_is_near_the_riccati_solution(curvature):
    path = circle(curvature)
    learner = learner_of(path, **UNLIMITED)
    assert learner.settle(at(0.0, 20.0))
    found = learner.local(np.asarray(1.0)).critic[:6]
    expected = riccati_weights(path, 1.0, **UNLIMITED)[:6]
    np.testing.assert_allclose(found, expected, atol=0.02 * expected.max())


def test_settled_weights_leave_little_of_the_bellman_error_before_a_bend():
    path = PATHS["figure eight"]
    random = np.random.default_rng(3)
    for place in (14.5, 15.5, 16.0, 16.6):  # the sharpest bend is at 17 m
        errors = random.uniform(-0.8, 0.8, (100, 3))
        follower = PathFollower(build(Settings, UNLIMITED), path, np.full(100, place))
        pose = pose_in_frame(errors, path.frame(np.full(100, place)).pose)
        follower.learn_at_rest(pose)
        output = follower.step(pose, 0.01)
        share = np.abs(output.bellman_error) / output.running_cost
        assert np.median(share) < 0.01
        assert share.max() < 0.1


@pytest.mark.parametrize("name", sorted(PATHS))
def test_learning_on_the_way_ends_where_settling_does(name):
    path = PATHS[name]
    online = PathFollower(build(Settings, {}), path, 12.0)
    last = driven(online, 12.0, (-0.3, 0.4, 0.5), 300)[-1]
    settled = learner_of(path)
    assert settled.settle(at(last.arc_length, 5.0))
    expected = settled.local(last.arc_length).critic
    scale = np.abs(expected).max()
    np.testing.assert_allclose(last.weights.critic, expected, atol=0.02 * scale)
    np.testing.assert_allclose(last.weights.actor, expected, atol=0.02 * scale)


def test_a_gradient_critic_goes_where_least_squares_are():
    exact = learner_of(PATHS["circle"])
    exact.settle(at(2.0, 5.0))
    target = exact.local(np.asarray(2.0)).critic
    misses = []
    for gain in (0.1, 10.0, 1e3):
        learner = learner_of(PATHS["circle"], critic="gradient", critic_gain_sampled=gain)
        learner.settle(at(2.0, 5.0))
        misses.append(np.linalg.norm(learner.local(np.asarray(2.0)).critic - target))
    assert misses[0] > 3.0 * misses[1] > 9.0 * misses[2]
    assert misses[2] < 1e-3 * np.linalg.norm(target)


def test_a_gradient_critic_comes_nearer_with_every_sweep():
    values = {**SMALL, "critic": "gradient", "critic_gain_sampled": 20.0}
    exact = learner_of(PATHS["circle"], **SMALL)
    exact.settle(at(2.0, 5.0))
    target = exact.local(np.asarray(2.0)).critic
    learner = learner_of(PATHS["circle"], **values)
    misses = []
    for _ in range(5):
        misses.append(np.linalg.norm(learner.local(np.asarray(2.0)).critic - target))
        for _ in range(400):
            learner.learn(at(2.0), 0.01)
    assert misses[:3] == sorted(misses[:3], reverse=True)
    assert max(misses[3:]) < misses[2] < 0.3 * misses[0]


# --- places and robots --------------------------------------------------------------------------


def test_weights_are_linear_between_knots_and_their_slope_says_so():
    learner = learner_of(PATHS["figure eight"], **SMALL)
    learner.settle(at(25.0, 5.0))
    spacing = PATHS["figure eight"].length / math.ceil(PATHS["figure eight"].length / 0.2)
    knots = 130 * spacing + np.array([0.0, spacing])
    ends = learner.local(knots + 1e-12)
    for share in (0.1, 0.5, 0.95):
        found = learner.local(np.asarray(knots[0] + share * spacing))
        for name in ("critic", "actor"):
            first, second = getattr(ends, name)
            expected = (1.0 - share) * first + share * second
            np.testing.assert_allclose(getattr(found, name), expected, atol=1e-9)
        np.testing.assert_allclose(found.slope, (ends.critic[1] - ends.critic[0]) / spacing)
        assert np.abs(found.slope).max() > 0.0


def test_robots_of_a_batch_at_one_place_learn_the_same():
    path = PATHS["figure eight"]
    alone = PathFollower(build(Settings, SMALL), path, 3.0)
    together = PathFollower(build(Settings, SMALL), path, np.full((2, 2), 3.0))
    error = np.array([0.1, -0.3, 0.4])
    pose = pose_in_frame(error, path.frame(3.0).pose)
    for _ in range(60):
        single = alone.step(pose, 0.02)
        batch = together.step(np.broadcast_to(pose, (2, 2, 3)), 0.02)
        assert batch.weights.actor.shape == (2, 2, len(single.weights.actor))
        for index in np.ndindex(2, 2):
            assert batch.weights.actor[index].tolist() == single.weights.actor.tolist()
            np.testing.assert_allclose(batch.command[index], single.command, rtol=1e-12)
        pose = advance_pose(pose, *single.command, 0.02)


@pytest.mark.parametrize("shape", [(2, 2), ()], ids=["own weights", "shared"])
def test_robots_at_different_places_have_the_weights_of_their_places(shape):
    places = np.array([[14.5, 15.5], [16.5, 17.0]])
    learner = learner_of(PATHS["figure eight"], shape=shape, **SMALL)
    for _ in range(1000):
        learner.learn(at(places), 0.01)
    together = learner.local(places)
    for index in np.ndindex(2, 2):
        single = learner_of(PATHS["figure eight"], **SMALL)
        single.settle(at(places[index], 5.0))
        expected = single.local(np.asarray(places[index])).critic
        scale = np.abs(expected).max()
        np.testing.assert_allclose(together.critic[index], expected, atol=0.01 * scale)
        np.testing.assert_allclose(together.actor[index], expected, atol=0.01 * scale)


@pytest.mark.parametrize("name", ["figure eight", "circle"])
def test_on_a_closed_path_every_lap_has_the_same_weights(name):
    path = PATHS[name]
    learner = learner_of(path, **SMALL)
    learner.settle(at(1.0, 5.0))
    for place in (0.013, 1.0, 3.33):
        here = learner.local(np.asarray(place))
        for laps in (-2, 1, 30):
            there = learner.local(np.asarray(place + laps * path.length))
            np.testing.assert_allclose(there.critic, here.critic, atol=1e-9)
            np.testing.assert_allclose(there.actor, here.actor, atol=1e-9)


def test_beyond_the_ends_of_an_open_path_it_goes_on_straight():
    path = PATHS["line"]
    learner = learner_of(path, **UNLIMITED)
    for place in (-1e3, -1.0, path.length - 0.3, path.length + 1.0, 1e6):
        learner.reset()
        assert learner.settle(at(place, 4.0))
        found = learner.local(np.asarray(place)).critic[:6]
        expected = riccati_weights(path, 5.0, **UNLIMITED)[:6]
        np.testing.assert_allclose(found, expected, rtol=0.01, atol=0.01 * expected.max())
        for _ in range(50):
            learner.learn(at(place), 0.01)
        assert learner.problem == ""


@pytest.mark.parametrize("name", ["figure eight", "line"])
def test_a_path_with_more_knots_than_are_remembered_is_learned_alike(name, monkeypatch):
    path = PATHS[name]
    runs = []
    for memory in (8192, 64):
        monkeypatch.setattr(knot_weights, "_MOST_KNOTS", memory)
        follower = PathFollower(build(Settings, SMALL), path, 28.0)
        runs.append(driven(follower, 28.0, (-0.3, 0.4, 0.5), 1000, 0.05))
    travelled = runs[0][-1].arc_length - runs[0][0].arc_length
    assert travelled > 64 * 0.2  # the memory went round
    for whole, ring in zip(*runs, strict=True):
        assert ring.weights.critic.tolist() == whole.weights.critic.tolist()
        assert ring.weights.actor.tolist() == whole.weights.actor.tolist()


def test_more_knots_than_are_remembered_do_not_matter_at_the_seam_of_a_closed_path(monkeypatch):
    path = PATHS["figure eight"]  # of 655 knots
    runs = []
    for memory in (8192, 650):
        monkeypatch.setattr(knot_weights, "_MOST_KNOTS", memory)
        follower = PathFollower(build(Settings, SMALL), path, 129.0)
        runs.append(driven(follower, 129.0, (-0.3, 0.4, 0.5), 200, 0.02))
    for whole, ring in zip(*runs, strict=True):
        np.testing.assert_allclose(ring.weights.actor, whole.weights.actor, atol=1e-6)


def test_a_whole_lap_of_a_circle_is_learned_alike():
    path = circle(1.0)
    learner = learner_of(path, **SMALL)
    assert learner.settle(at(0.0, 21.0))
    critic = learner.local(np.linspace(0.0, path.length, 50)).critic
    np.testing.assert_allclose(
        critic, critic[:1] + np.zeros((50, 1)), atol=0.02
    )  # the preview ends


# --- the start ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["riccati", "listed"])
@pytest.mark.parametrize("name", sorted(PATHS))
def test_it_starts_from_the_initial_weights_of_the_settings(kind, name):
    lists = {"initial_critic_weights": LISTED, "initial_actor_weights": LISTED[::-1]}
    learner = learner_of(PATHS[name], **SMALL, **lists, initial_weights=kind)
    for place in (0.0, 3.3, 77.7):
        found = learner.local(np.asarray(place))
        if kind == "listed":
            assert found.critic.tolist() == pytest.approx([*LISTED, *[0.0] * 10])
            assert found.actor.tolist() == pytest.approx([*LISTED[::-1], *[0.0] * 10])
        else:
            expected = riccati_weights(PATHS[name], place)[: len(found.critic)]
            np.testing.assert_allclose(found.critic[:6], expected[:6], atol=5e-3)
            assert found.actor.tolist() == found.critic.tolist()


def test_a_reset_returns_to_the_initial_weights_and_of_single_robots_to_nothing():
    learner = learner_of(PATHS["figure eight"], **SMALL)
    first = learner.local(np.asarray(30.0)).critic
    learner.settle(at(29.0, 3.0))
    learned = learner.local(np.asarray(30.0)).critic
    assert learned.tolist() != first.tolist()
    learner.reset(np.array([True, False]))  # robots share the weights
    assert learner.local(np.asarray(30.0)).critic.tolist() == learned.tolist()
    learner.reset()
    assert learner.local(np.asarray(30.0)).critic.tolist() == first.tolist()
    assert learner.problem == ""


REST_PATHS = {"figure eight": lissajous(), "circle": circle(0.5)}


def steps_until_rest(learner, model, place):
    """Let a robot stand until its learner works no more; return after how many steps."""
    for step in range(2000):
        before = len(model.parts)
        learner.learn(at(place), 0.01)
        if len(model.parts) == before:
            return step
    raise AssertionError("it never rests")


def test_a_learner_that_has_learned_all_ahead_rests_until_the_robot_has_come_on():
    learner = learner_of(REST_PATHS["figure eight"], **SMALL)
    learner._model = model = CountingModel(learner._model)
    assert steps_until_rest(learner, model, 14.5) > 12  # knots of the preview
    done = len(model.parts)
    for _ in range(100):
        learner.learn(at(14.5), 0.01)
    assert len(model.parts) == done
    settled = learner_of(REST_PATHS["figure eight"], **SMALL)
    settled.settle(at(14.5, 0.0))
    found, expected = learner.local(np.asarray(14.5)), settled.local(np.asarray(14.5))
    # Rests change nothing: what is learned before one is what would be learned in its place.
    np.testing.assert_allclose(found.critic, expected.critic, rtol=1e-9)
    np.testing.assert_allclose(found.actor, expected.critic, rtol=1e-9)
    for place in (15.4, 14.0):  # more than three knots on; back, behind where it began
        learner.learn(at(place), 0.01)
        assert len(model.parts) > done
        steps_until_rest(learner, model, place)
        done = len(model.parts)


@pytest.mark.parametrize(
    "values", [{"critic": "gradient"}, {"actor_weight_bound": 2.5}], ids=["gradient", "refused"]
)
def test_a_learner_with_something_left_to_learn_does_not_rest(values):
    learner = learner_of(REST_PATHS["circle"], **SMALL, **values)
    learner._model = model = CountingModel(learner._model)
    with pytest.raises(AssertionError, match="never rests"):
        steps_until_rest(learner, model, 1.0)


def test_lost_weights_end_the_rest():
    learner = learner_of(REST_PATHS["circle"], **SMALL)
    learner._model = model = CountingModel(learner._model)
    steps_until_rest(learner, model, 1.0)
    expected = learner.local(np.asarray(1.0)).critic.copy()
    learner._knots.critic[:] = np.nan
    for _ in range(100):
        learner.learn(at(1.0), 0.01)
    np.testing.assert_allclose(learner.local(np.asarray(1.0)).critic, expected, rtol=1e-9)
