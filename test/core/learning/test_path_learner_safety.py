"""Learning along a path: what is kept from a predecessor, and what happens when it goes wrong."""

import math
import re

import numpy as np
import pytest
from steady import steady_schedule

from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import advance_pose, pose_in_frame
from adp_path_follower.core.learning import sweep
from adp_path_follower.core.learning.bellman import Observation
from adp_path_follower.core.learning.path_learner import PathLearner
from adp_path_follower.core.path.library import circle, lissajous
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build, update

EIGHT = lissajous()
SMALL = {"basis_degree": 3, "sample_count": 64, "samples_per_step": 64}
NARROW_BOUND = {"actor_weight_bound": 3.9}  # below the learned weights' norm, above Riccati's
WIDE_SAMPLES = {
    "basis_degree": 4,
    "frame": "serret_frenet",
    "sample_half_widths": (100.0, 100.0, 100.0, 0.5),
    "desired_speed": 0.05,  # at 0.5 m/s one of 13 knots is refused, and nothing is the matter
}
REFUSED = {
    "bound": (NARROW_BOUND, r"critic's weights have norm [\d.]+, above actor_weight_bound 3\.9"),
    "residual": (WIDE_SAMPLES, r"Bellman errors at the samples are \d+% .*, above 50%"),
}


def at(place, distance):
    """Return an observation at a place; a learner along the path asks for no measurements."""
    return Observation(np.asarray(place, float), lambda: pytest.fail("measured"), distance)


def riccati_weights(follower):
    """Return the weights of the Riccati policy where the target is, shape (L,)."""
    tuning = follower.settings
    schedule = steady_schedule(follower.path, tuning.target, tuning.cost)
    matrix = schedule.matrix(
        follower.path.curvature(follower.arc_length), tuning.target.desired_speed
    )
    return tuning.learning.value_basis.quadratic_weights(matrix)


class Drive:
    """A follower and a robot in closed loop."""

    def __init__(self, values, start=10.0, error=(-0.3, 0.4, 0.5)):
        self.follower = PathFollower(build(Settings, values), EIGHT, start)
        self.pose = pose_in_frame(np.array(error), EIGHT.frame(start).pose)

    def steps(self, count):
        """Return the last output of so many steps of 20 ms; every command is finite."""
        for _ in range(count):
            output = self.follower.step(self.pose, 0.02)
            assert np.isfinite(output.command).all()
            self.pose = advance_pose(self.pose, *output.command, 0.02)
        return output


# --- what is kept -------------------------------------------------------------------------------


def learned(**changes):
    """Return a follower that has learned, and one of changed settings that has taken over."""
    drive = Drive(SMALL)
    drive.steps(150)
    changed = update(drive.follower.settings, changes)
    return drive.follower, drive.follower.reconfigured(changed)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"actor_gain": 3.0},
        {"actor_weight_bound": 50.0},
        {"critic": "gradient"},
        {"samples_per_step": 7},
        {"learning": False},
        {"wide_region": "riccati"},
        {"odom_timeout": 2.0},
    ],
    ids=str,
)
def test_what_was_learned_stays_while_the_problem_is_the_same(changes):
    before, after = learned(**changes)
    assert before.weights.critic.tolist() != riccati_weights(before).tolist()
    assert after.weights.critic.tolist() == before.weights.critic.tolist()
    assert after.weights.actor.tolist() == before.weights.actor.tolist()


@pytest.mark.parametrize(
    "changes",
    [
        {"desired_speed": 0.4},
        {"target_gain": 0.3},
        {"state_cost": (1.0, 2.0, 1.0)},
        {"input_cost": (1.0, 2.0)},
        {"max_angular_vel": 1.0},
        {"basis_degree": 4},
        {"frame": "serret_frenet"},
        {"knot_spacing": 0.25},
        {"preview_distance": 3.0},
        {"sample_count": 65},
        {"sample_half_widths": (1.0, 1.0, 1.0, 0.5)},
        {"sample_seed": 1},
    ],
    ids=str,
)
def test_what_was_learned_is_dropped_for_another_problem(changes):
    before, after = learned(**changes)
    assert after.arc_length == before.arc_length
    scale = np.abs(after.weights.critic).max()
    np.testing.assert_allclose(after.weights.critic, riccati_weights(after), atol=0.01 * scale)
    assert after.weights.actor.tolist() == after.weights.critic.tolist()


def test_weights_of_another_path_or_of_another_learner_are_not_taken_over():
    before, _ = learned()
    mirrored = PathFollower(before.settings, circle(-0.5), 1.0)
    mirrored.take_over(before)
    np.testing.assert_allclose(mirrored.weights.critic, riccati_weights(mirrored), atol=1e-6)
    by_phi = PathFollower(update(before.settings, {"scheduling": "path_state"}), EIGHT, 10.0)
    start = by_phi.weights.critic
    by_phi.take_over(before)
    assert by_phi.weights.critic.tolist() == start.tolist()
    again = PathFollower(before.settings, EIGHT, before.arc_length)
    start = again.weights.critic
    again.take_over(by_phi)
    assert again.weights.critic.tolist() == start.tolist()


# --- critics that are refused -------------------------------------------------------------------


@pytest.mark.parametrize("cause", ["bound", "residual"])
def test_a_critic_that_is_not_to_be_trusted_leaves_the_riccati_policy(cause, monkeypatch):
    if cause == "residual":
        monkeypatch.setattr(sweep, "_MOST_RESIDUAL", 1e-4)
    drive = Drive(NARROW_BOUND if cause == "bound" else {})
    drive.steps(150)
    follower = drive.follower
    sentence = "norm 3.9" if cause == "bound" else "of the running cost, above 0%"
    assert sentence in follower.learning_problem
    expected = riccati_weights(follower)
    # Knots hold the solution of the mean curvature about them.
    np.testing.assert_allclose(follower.weights.critic, expected, atol=0.01 * abs(expected).max())
    np.testing.assert_allclose(follower.weights.actor, follower.weights.critic, atol=1e-9)


@pytest.mark.parametrize("cause", sorted(REFUSED))
def test_the_problem_names_the_cause_and_the_bound(cause):
    values, sentence = REFUSED[cause]
    drive = Drive(values)
    drive.steps(150)
    assert re.search(sentence, drive.follower.learning_problem)


@pytest.mark.parametrize("cause", sorted(REFUSED))
def test_settling_tells_that_a_critic_was_refused(cause):
    values, _ = REFUSED[cause]
    drive = Drive(values)
    assert not drive.follower.learn_at_rest(drive.pose, 1.0)
    assert drive.follower.learning_problem
    healthy = Drive({})
    assert healthy.follower.learn_at_rest(healthy.pose, 1.0)
    assert healthy.follower.learning_problem == ""


@pytest.mark.parametrize("cause", sorted(REFUSED))
def test_without_the_cause_learning_goes_on(cause):
    drive = Drive(REFUSED[cause][0])
    drive.steps(100)
    assert drive.follower.learning_problem
    drive.follower = drive.follower.reconfigured(build(Settings, {}))
    drive.steps(200)
    assert drive.follower.learning_problem == ""
    settled = PathLearner(
        build(Settings, {}),
        drive.follower._learner._knots._riccati,  # of the same problem
    )
    assert settled.settle(at(drive.follower.arc_length, 2.0))
    expected = settled.local(drive.follower.arc_length).critic
    scale = np.abs(expected).max()
    np.testing.assert_allclose(drive.follower.weights.critic, expected, atol=0.02 * scale)


def test_however_small_the_bound_the_riccati_policy_is_exempt_from_it():
    drive = Drive({"actor_weight_bound": 0.5})
    drive.steps(100)
    assert "above actor_weight_bound 0.5" in drive.follower.learning_problem
    weights = drive.follower.weights
    assert np.linalg.norm(weights.actor) > 2.0
    np.testing.assert_allclose(weights.actor, weights.critic, atol=1e-6)


# --- numbers that are no numbers ----------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of the difference of two infinities
@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("array", ["critic", "actor"])
@pytest.mark.parametrize("everywhere", [True, False])
@pytest.mark.parametrize("critic", ["least_squares", "gradient"])
def test_weights_that_are_not_finite_are_replaced_at_once_and_learned_anew(
    bad, array, everywhere, critic
):
    values = {**SMALL, "critic": critic, "critic_gain_sampled": 1e3}
    drive = Drive(values)
    drive.steps(150)
    follower = drive.follower
    stored = getattr(follower._learner._knots, array)
    if everywhere:
        stored[:] = bad
    else:
        stored[:, 3] = bad
    found = follower.weights
    expected = riccati_weights(follower)
    np.testing.assert_allclose(found.critic, expected, atol=1e-9)
    np.testing.assert_allclose(found.actor, expected, atol=1e-9)
    output = drive.steps(1)
    np.testing.assert_allclose(output.weights.actor, riccati_weights(follower), atol=1e-2)
    assert np.isfinite(output.bellman_error).all()
    assert follower.learning_problem == "weights are not finite"
    drive.steps(60)
    assert follower.learning_problem == ""
    drive.steps(340)
    settled = PathLearner(follower.settings, follower._learner._knots._riccati)
    assert settled.settle(at(follower.arc_length, 2.0))
    target = settled.local(follower.arc_length).critic
    np.testing.assert_allclose(follower.weights.actor, target, atol=0.03 * np.abs(target).max())


def test_without_learning_weights_that_are_not_finite_are_replaced_as_well():
    drive = Drive({**SMALL, "learning": False})
    drive.steps(3)
    drive.follower._learner._knots.critic[:] = math.nan
    output = drive.steps(3)
    assert output.weights.actor.tolist() == riccati_weights(drive.follower).tolist()


def test_only_the_robot_whose_weights_are_not_finite_has_the_riccati_policy():
    tuning = build(Settings, SMALL)
    schedule = steady_schedule(EIGHT, tuning.target, tuning.cost)
    learner = PathLearner(tuning, schedule, (2,))
    places = np.array([10.0, 40.0])
    learner.settle(at(places, 1.0))
    before = learner.local(places)
    knot = int(40.0 / (EIGHT.length / 655))
    learner._knots.actor[2 * knot + 1] = math.nan  # of the second robot
    after = learner.local(places)
    assert after.actor[0].tolist() == before.actor[0].tolist()
    matrix = schedule.matrix(EIGHT.curvature(40.0), tuning.target.desired_speed)
    expected = tuning.learning.value_basis.quadratic_weights(matrix)
    np.testing.assert_allclose(after.actor[1], expected, atol=1e-12)
    assert after.slope[1].tolist() == [0.0] * len(expected)
    assert after.slope[0].tolist() == before.slope[0].tolist()
