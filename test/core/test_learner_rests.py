"""When a learner along a path rests, and what ends the rest."""

import numpy as np
import pytest
from test_arc_length_learner import SMALL, UNUSED, CountingModel, at, learner_of

from adp_path_follower.core.path.library import circle, lissajous

PATHS = {"figure eight": lissajous(), "circle": circle(0.5)}


def steps_until_rest(learner, model, place):
    """Let a robot stand until its learner works no more; return after how many steps."""
    for step in range(2000):
        before = len(model.parts)
        learner.learn(UNUSED, at(place), 0.01)
        if len(model.parts) == before:
            return step
    raise AssertionError("it never rests")


def test_a_learner_that_has_learned_all_ahead_rests_until_the_robot_has_come_on():
    learner = learner_of(PATHS["figure eight"], **SMALL)
    learner._model = model = CountingModel(learner._model)
    assert steps_until_rest(learner, model, 14.5) > 12  # knots of the preview
    done = len(model.parts)
    for _ in range(100):
        learner.learn(UNUSED, at(14.5), 0.01)
    assert len(model.parts) == done
    settled = learner_of(PATHS["figure eight"], **SMALL)
    settled.settle(UNUSED, at(14.5), 0.0)
    found, expected = learner.local(at(14.5)), settled.local(at(14.5))
    # Rests change nothing: what is learned before one is what would be learned in its place.
    np.testing.assert_allclose(found.weights.critic, expected.weights.critic, rtol=1e-9)
    np.testing.assert_allclose(found.weights.actor, expected.weights.critic, rtol=1e-9)
    for place in (15.4, 14.0):  # more than three knots on; back, behind where it began
        learner.learn(UNUSED, at(place), 0.01)
        assert len(model.parts) > done
        steps_until_rest(learner, model, place)
        done = len(model.parts)


@pytest.mark.parametrize(
    "values", [{"critic": "gradient"}, {"actor_weight_bound": 2.5}], ids=["gradient", "refused"]
)
def test_a_learner_with_something_left_to_learn_does_not_rest(values):
    learner = learner_of(PATHS["circle"], **SMALL, **values)
    learner._model = model = CountingModel(learner._model)
    with pytest.raises(AssertionError, match="never rests"):
        steps_until_rest(learner, model, 1.0)


def test_lost_weights_end_the_rest():
    learner = learner_of(PATHS["circle"], **SMALL)
    learner._model = model = CountingModel(learner._model)
    steps_until_rest(learner, model, 1.0)
    expected = learner.local(at(1.0)).weights.critic.copy()
    learner._memory.critic[:] = np.nan
    for _ in range(100):
        learner.learn(UNUSED, at(1.0), 0.01)
    np.testing.assert_allclose(learner.local(at(1.0)).weights.critic, expected, rtol=1e-9)
