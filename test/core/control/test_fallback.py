"""Where the Riccati policy takes over, and that it is never the worse for it."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from steady import steady_schedule

from adp_path_follower.core.control.fallback import Distrust, RiccatiPolicy, is_doubtful
from adp_path_follower.core.control.riccati import riccati_solution
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import advance_pose, pose_in_frame
from adp_path_follower.core.path.library import lissajous, named_path
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.simulation.simulate import simulate

UNLIMITED = {
    "min_linear_vel": -math.inf,
    "max_linear_vel": math.inf,
    "max_angular_vel": math.inf,
}
STARTS = np.array([[0.9, 0.8, -0.9], [-0.8, 0.9, 1.0], [0.3, -0.95, -1.0], [-0.9, -0.9, 0.9]])
positive = st.floats(1e-6, 1e6)


@settings(max_examples=100)
@given(cost=positive, share=st.floats(-2.0, 3.0), value=positive, ratio=st.floats(-2.0, 3.0))
def test_trust_ends_where_the_value_falls_too_slowly_or_is_too_small(cost, share, value, ratio):
    assume(abs(share - 0.5) > 1e-5)
    assume(abs(ratio - 0.1) > 1e-5)
    found = bool(is_doubtful(*map(np.array, (share * cost, cost, ratio * value, value))))
    assert found == (share > 0.5 or ratio < 0.1)


def test_on_the_path_nothing_is_doubted():
    nothing = np.zeros(())
    assert not is_doubtful(nothing, nothing, nothing, nothing)


def test_the_first_decision_takes_effect_at_once_and_later_ones_change_over_steadily():
    distrust, doubtful = Distrust(), np.array([True, False])
    np.testing.assert_array_equal(distrust.share(doubtful, 0.01), [1.0, 0.0])
    shares = np.array([distrust.share(~doubtful, 0.01) for _ in range(200)])
    assert np.abs(np.diff(shares, axis=0)).max() <= 0.05 + 1e-12
    assert (shares[:45, 0] == 1.0).all()  # half a second on probation
    assert (shares[75:, 0] == 0.0).all()
    assert (shares[25:, 1] == 1.0).all()
    distrust.reset()
    np.testing.assert_array_equal(distrust.share(doubtful, 0.01), [1.0, 0.0])


def test_the_riccati_policy_is_the_linear_one_near_the_path():
    tuning, path = build(Settings, UNLIMITED), named_path("circle:0.5")
    policy = RiccatiPolicy(tuning, steady_schedule(path, tuning.target, tuning.cost))
    error = 1e-5 * np.array([1.0, -2.0, 3.0])
    found = policy.modified_input(np.append(error, 0.0), np.array(0.5), np.zeros(2))
    solution = riccati_solution(0.5, tuning.target.desired_speed, tuning.target, tuning.cost)
    np.testing.assert_allclose(found, -solution[[0, 2]] @ error, rtol=1e-3, atol=1e-9)
    value = policy.value(np.append(error, 0.0), np.array(0.5), 0.5)
    assert float(value) == pytest.approx(error @ solution @ error, rel=1e-3)


def test_weights_that_make_no_value_function_do_not_drive():
    tuning = build(Settings, {**UNLIMITED, "learning": False})
    sound = PathFollower(tuning, lissajous(), 5.0)
    wrong = build(
        Settings,
        {
            **flattened(tuning),
            "initial_weights": "listed",
            "initial_critic_weights": [-1.0, 0.0, 0.0, -1.0, 0.0, -1.0],
            "initial_actor_weights": [-1.0, 0.0, 0.0, -1.0, 0.0, -1.0],
        },
    )
    follower = PathFollower(wrong, lissajous(), 5.0)
    pose = pose_in_frame(np.array([0.2, 0.3, 0.4]), lissajous().frame(5.0).pose)
    output, expected = follower.step(pose, 0.01), sound.step(pose, 0.01)
    assert output.doubt == 1.0
    assert expected.doubt == 0.0
    np.testing.assert_allclose(output.command, expected.command, atol=1e-3)
    assert "does not decrease" in follower.learning_problem
    assert sound.learning_problem == ""


def flattened(tuning):
    """Return the values of settings that differ from the defaults here."""
    return {**UNLIMITED, "learning": tuning.learning.learning}


@pytest.mark.parametrize(
    "change",
    [
        {"state_cost": (1.0, 10.0, 1.0)},  # without the fallback one of forty starts costs 60 J*
        {"input_cost": (0.2, 0.2)},
        {"desired_speed": 0.1},
    ],
)
def test_far_from_the_default_problem_it_is_no_worse_than_the_riccati_policy(change):
    tuning = build(Settings, {**UNLIMITED, **change})
    learned, riccati = (
        simulate(tuning, lissajous(), STARTS, learning=learning, duration=20.0, rate=50.0)
        for learning in ("warm", "frozen")
    )
    assert (learned.cost <= 1.02 * riccati.cost).all()
    assert learned.cost.mean() < riccati.cost.mean()


@pytest.mark.parametrize(
    ("start", "place", "steps"),
    [((-0.3, 0.3, 0.5), 0.0, 100), ((0.0, 0.4, 0.0), 0.0, 100), ((0.0, 0.0, 0.0), 13.0, 250)],
)
def test_nothing_is_doubted_from_rest_nor_at_errors_that_nobody_minds(start, place, steps):
    limits = {"max_linear_accel": 1.0, "max_linear_decel": 1.0, "max_angular_accel": 6.0}
    corners = [(0, 0), (4, 0), (4, 3), (1, 3), (1, 6), (5, 6)]
    path = prepare(corners, PathSettings()).segments[0].path
    follower = PathFollower(build(Settings, limits), path, place)
    pose = pose_in_frame(np.array(start), path.frame(place).pose)
    for _ in range(steps):
        output = follower.step(pose, 0.01)
        assert follower.learning_problem == ""
        pose = advance_pose(pose, *output.command, 0.01)
