"""The problem changes while the robot drives: the policy of the new one is learned in seconds."""

import gc
import math

import numpy as np
import pytest

from adp_path_follower.core.control.far_from_path import WideRegion
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import advance_pose, pose_in_frame
from adp_path_follower.core.path.library import circle, lissajous, named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build, update

EIGHT = lissajous()
PERIOD = 0.01
CHANGES = {
    "faster": {"desired_speed": 0.9},
    "slower": {"desired_speed": 0.25},
    "another state cost": {"state_cost": (0.5, 6.0, 2.0)},
    "an error that costs nothing": {"state_cost": (1.0, 1.0, 0.0)},
    "dear steering": {"input_cost": (1.0, 8.0)},
    "no limits": {
        "min_linear_vel": -math.inf,
        "max_linear_vel": math.inf,
        "max_angular_vel": math.inf,
    },
    "tight limits": {"max_linear_vel": 0.6, "max_angular_vel": 0.8},
    "another target": {"target_gain": 0.6},
}


class Robot:
    """A robot in closed loop with whatever follower it has."""

    def __init__(self, follower, error):
        self.follower = follower
        frame = follower.path.frame(follower.arc_length)
        self.pose = pose_in_frame(np.array(error), frame.pose)

    def drive(self, duration):
        """Return the outputs of so many seconds, all of them sound."""
        outputs = []
        for _ in range(round(duration / PERIOD)):
            outputs.append(self.follower.step(self.pose, PERIOD))
            assert np.isfinite(outputs[-1].command).all()
            self.pose = advance_pose(self.pose, *outputs[-1].command, PERIOD)
        return outputs

    def change(self, changes):
        """Go on with other settings."""
        self.follower = self.follower.reconfigured(update(self.follower.settings, changes))


def settled_weights(follower, pose, distance=0.0):
    """Return the weights of a follower that has settled there, with so much more preview [m]."""
    fresh = PathFollower(follower.settings, follower.path, follower.arc_length)
    assert fresh.learn_at_rest(pose, distance)
    return fresh.weights


def assert_learned(robot):
    found, expected = robot.follower.weights, settled_weights(robot.follower, robot.pose)
    scale = np.abs(expected.critic).max()
    # While a sweep goes on, the robot uses up some of the last one's preview.
    np.testing.assert_allclose(found.critic, expected.critic, rtol=0.02, atol=0.05 * scale)
    np.testing.assert_allclose(found.actor, expected.actor, rtol=0.02, atol=0.05 * scale)
    # More preview would hardly change the quadratic part.
    further = settled_weights(robot.follower, robot.pose, 10.0)
    np.testing.assert_allclose(found.critic[:6], further.critic[:6], atol=0.02 * scale)
    assert robot.follower.learning_problem == ""


@pytest.mark.parametrize("name", sorted(CHANGES))
def test_two_seconds_after_a_change_the_weights_are_those_of_the_new_problem(name):
    robot = Robot(PathFollower(build(Settings, {}), EIGHT, 13.0), (-0.3, 0.3, 0.4))
    robot.drive(2.5)
    before, last = robot.follower.weights, robot.follower.arc_length
    robot.change(CHANGES[name])
    assert robot.follower.arc_length == last
    outputs = robot.drive(2.0)
    assert max(np.linalg.norm(output.error) for output in outputs) < 0.6
    assert_learned(robot)
    after = robot.follower.weights
    assert np.abs(after.critic - before.critic).max() > 0.02  # it was another problem
    assert np.linalg.norm(robot.drive(8.0)[-1].error) < 0.15


@pytest.mark.parametrize("curvature", [1.0, -1.0, 0.1])
def test_two_seconds_on_a_new_path_are_enough_as_well(curvature):
    robot = Robot(PathFollower(build(Settings, {}), named_path("line"), 5.0), (0.2, -0.3, 0.1))
    robot.drive(2.0)
    bend = circle(curvature)
    follower = PathFollower(robot.follower.settings, bend, 0.5)
    follower.take_over(robot.follower)
    robot = Robot(follower, robot.drive(0.01)[-1].error)
    outputs = robot.drive(2.0)
    assert max(np.linalg.norm(output.error) for output in outputs) < 0.6
    assert_learned(robot)
    assert np.linalg.norm(robot.drive(8.0)[-1].error) < 0.05


def test_many_changes_in_a_row_do_no_harm():
    robot = Robot(PathFollower(build(Settings, {}), EIGHT, 20.0), (0.5, -0.4, 0.7))
    original = {"desired_speed": 0.5, "state_cost": (1.0, 1.0, 1.0), "input_cost": (1.0, 1.0)}
    for changes in [{"desired_speed": 0.3 + 0.01 * step} for step in range(20)]:
        outputs = robot.drive(0.1)
        assert max(np.linalg.norm(output.error) for output in outputs) < 1.3
        robot.change(changes)
    for name in ("another state cost", "dear steering", "faster"):
        robot.change(CHANGES[name])
        robot.drive(0.05)
    robot.change(original)
    robot.drive(2.0)
    assert_learned(robot)


def test_the_place_and_the_cost_go_on_over_a_change():
    robot = Robot(PathFollower(build(Settings, {}), EIGHT, 13.0), (-0.3, 0.3, 0.4))
    robot.drive(0.5)
    cost, place = float(robot.follower.cost), float(robot.follower.arc_length)
    robot.change({"desired_speed": 0.8})
    assert float(robot.follower.cost) == cost > 0.0
    first, second = robot.drive(0.02)
    # The target moves on by Heun's rule at the new speed, without a break.
    speed = 0.8 * math.cos(first.error[2]) + 0.1 * first.error[0]
    assert first.arc_length - place == pytest.approx(speed * PERIOD, rel=0.05)
    assert second.arc_length > first.arc_length
    assert float(robot.follower.cost) > cost


def test_far_policies_that_were_left_are_forgotten():
    """Each would keep its own forerunner, and a node that is tuned for an hour all of them."""

    def alive():
        gc.collect()
        return sum(isinstance(item, WideRegion) for item in gc.get_objects())

    others = alive()
    follower = PathFollower(build(Settings, {"wide_region": "approach"}), EIGHT)
    robot = Robot(follower, [0.0, 0.3, 0.2])
    for kind in ("none", "riccati", "approach", "none"):
        follower.settings = update(follower.settings, {"wide_region": kind})
        robot.drive(0.1)
        assert alive() - others == 2
    robot.drive(1.0)
    assert alive() - others == 1
