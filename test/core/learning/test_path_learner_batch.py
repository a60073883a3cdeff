"""Robots that learn together have the weights of robots that learn alone, to the last bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.learning import knot_weights, path_learner
from adp_path_follower.core.learning.bellman import Observation
from adp_path_follower.core.learning.path_learner import PathLearner
from adp_path_follower.core.path.library import circle, lissajous, named_path
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

PATHS = {"figure eight": lissajous(), "small circle": circle(1.0), "line": named_path("line")}
SMALL = {"basis_degree": 2, "sample_count": 40, "samples_per_step": 16, "preview_distance": 1.0}
VARIANTS = {
    "least squares": {},
    "gradient": {"critic": "gradient", "critic_gain_sampled": 50.0},
    "refused": {"actor_weight_bound": 2.5},
    "slow in bends": {"max_lateral_accel": 0.05},
}
PERIODS = (0.0, 0.02, 0.05, 0.01)  # [s], in turns


def learners(path, count, values):
    tuning = build(Settings, {**SMALL, **values})
    profile = SpeedProfile(path, tuning)
    riccati = RiccatiSchedule(path, tuning.target, tuning.cost, profile)
    fleet = PathLearner(tuning, riccati, (count,))
    return fleet, [PathLearner(tuning, riccati) for _ in range(count)]


def at(places, distance=0.0):
    """Return an observation at places; a learner along the path asks for no measurements."""
    return Observation(np.asarray(places), lambda: pytest.fail("measured"), distance)


def assert_same_weights(fleet, alone, places):
    together = fleet.local(places)
    for index, learner in enumerate(alone):
        single = learner.local(places[index])
        for name in ("critic", "actor"):
            found, expected = getattr(together, name)[index], getattr(single, name)
            np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(together.slope[index], single.slope)


def assert_same(fleet, alone, places):
    assert_same_weights(fleet, alone, places)
    for index, learner in enumerate(alone):
        np.testing.assert_array_equal(fleet.sampled.excitation[index], learner.sampled.excitation)


def learn(fleet, alone, places, step):
    fleet.learn(at(places), PERIODS[step % len(PERIODS)])
    for index, learner in enumerate(alone):
        learner.learn(at(places[index]), PERIODS[step % len(PERIODS)])


@pytest.mark.parametrize("variant", sorted(VARIANTS))
@pytest.mark.parametrize("name", sorted(PATHS))
@settings(max_examples=4)
@given(
    starts=st.lists(st.floats(-3.0, 40.0), min_size=3, max_size=3),
    speeds=st.lists(st.floats(-3.0, 6.0), min_size=3, max_size=3),
)
def test_robots_learn_together_as_they_do_alone(name, variant, starts, speeds):
    fleet, alone = learners(PATHS[name], 5, VARIANTS[variant])
    # Two of them at the same place, one behind another.
    first = np.array([*starts, starts[0], starts[0] - 0.3])
    speed = np.array([*speeds, speeds[0], speeds[0]])
    for step in range(60):
        places = first + 0.02 * step * speed
        learn(fleet, alone, places, step)
        if step % 6 == 0:
            assert_same(fleet, alone, places)
    assert_same(fleet, alone, places)
    assert bool(fleet.problem) == any(learner.problem for learner in alone)


@pytest.mark.parametrize("critic", ["least_squares", "gradient"])
@pytest.mark.parametrize("reach", [1.0, 30.0])
def test_robots_settle_together_as_they_do_alone(critic, reach):
    fleet, alone = learners(PATHS["figure eight"], 4, {"critic": critic})
    places = np.array([3.0, 12.0, 3.1, 16.5])
    settled = [alone[index].settle(at(places[index], reach)) for index in range(4)]
    assert fleet.settle(at(places, reach)) == all(settled)
    for step in range(20):
        assert_same(fleet, alone, places)
        learn(fleet, alone, places, step)
        places = places + 0.05


def test_settling_tells_that_one_robot_did_not():
    fleet, alone = learners(PATHS["figure eight"], 2, {"actor_weight_bound": 2.5})
    places = np.array([3.0, 12.0])
    assert not any(alone[index].settle(at(places[index], 3.0)) for index in range(2))
    assert not fleet.settle(at(places, 3.0))
    assert fleet.problem in [learner.problem for learner in alone]


@pytest.mark.parametrize("limit", [0, 20])
def test_what_is_forgotten_is_found_again(limit, monkeypatch):
    monkeypatch.setattr(path_learner, "_MOST_UPDATES", limit)
    fleet, alone = learners(PATHS["figure eight"], 3, {})
    places = np.array([10.0, 12.0, 12.1])
    for step in range(80):
        learn(fleet, alone, places + 0.03 * step, step)
    assert_same(fleet, alone, places)
    updates = sum(len(sweep.updates) for sweep in fleet._sweeps.values())
    assert updates <= limit + 3 * (fleet._window + 1)


def test_robots_near_one_another_share_the_work():
    fleet, _ = learners(PATHS["figure eight"], 50, {})
    calls = []
    update = fleet._critic.update
    fleet._critic.update = lambda *args: calls.append(args) or update(*args)
    places = np.linspace(10.01, 10.3, 50)  # over two or three knots
    for _ in range(100):
        fleet.learn(at(places), 0.01)
    assert 0 < len(calls) < 100


def test_more_laps_than_are_remembered_do_not_matter(monkeypatch):
    monkeypatch.setattr(knot_weights, "_MOST_KNOTS", 20)
    fleet, alone = learners(PATHS["figure eight"], 3, {})
    for step in range(80):
        places = np.array([3.0, 100.0, 135.0]) + 0.1 * step
        learn(fleet, alone, places, step)
        assert_same(fleet, alone, places)


def test_a_robot_that_is_reset_begins_again_and_the_others_go_on():
    fleet, alone = learners(PATHS["figure eight"], 3, {})
    places = np.array([3.0, 12.0, 15.0])
    for step in range(40):
        if step == 20:
            fleet.reset(np.array([False, True, False]))
            alone[1].reset()
            assert_same_weights(fleet, alone, places)
        learn(fleet, alone, places, step)
    assert_same(fleet, alone, places)
    fleet.reset()
    for learner in alone:
        learner.reset()
    assert_same(fleet, alone, places)


@pytest.mark.parametrize("kind", ["critic", "actor"])
def test_a_robot_whose_weights_break_learns_anew_and_the_others_go_on(kind):
    fleet, alone = learners(PATHS["figure eight"], 20, {})
    places = np.linspace(3.0, 12.0, 20)
    for step in range(40):
        if step == 25:
            for learner in alone[:1]:
                getattr(learner._knots, kind)[:] = np.nan
            getattr(fleet._knots, kind)[::20] = np.nan  # of the first robot
        learn(fleet, alone, places, step)
        assert np.isfinite(fleet.local(places).actor).all()
    assert_same(fleet, alone, places)
    assert fleet.problem == alone[0].problem


def test_robots_far_from_everything_disturb_nobody():
    fleet, alone = learners(PATHS["line"], 4, {})
    places = np.array([3.0, 1e30, -1e9, 3.5])
    for step in range(30):
        learn(fleet, alone, places, step)
    assert_same(fleet, alone, places)


def test_all_robots_go_on_from_what_one_has_learned():
    fleet, alone = learners(PATHS["figure eight"], 2, {})
    teacher = learners(PATHS["figure eight"], 1, {})[1][0]
    teacher.settle(at(10.0, 5.0))
    learned = teacher.learned()
    assert fleet.start_from(learned) == ""
    assert [learner.start_from(learned) for learner in alone] == ["", ""]
    places = np.array([10.0, 11.0])
    for step in range(20):
        assert_same(fleet, alone, places)
        learn(fleet, alone, places, step)
    again, expected = fleet.learned(), alone[0].learned()
    assert again.knots.tolist() == expected.knots.tolist()
    assert again.reach == expected.reach
    np.testing.assert_array_equal(again.critic, expected.critic)
