"""The far policy improved on the path as it is, beside closed forms and finite differences."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from steady import steady_schedule

from adp_path_follower.core.control.dynamic_programming import MotionModel
from adp_path_follower.core.control.far_from_path import WideRegion
from adp_path_follower.core.control.lookahead import FarFromPath
from adp_path_follower.core.control.riccati import INPUT_MATRIX, riccati_solution
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import advance_pose, pose_in_frame
from adp_path_follower.core.path.library import circle, named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

BEND = 15.527  # [m] of the paper's path, 1.5 m before the sharpest bend
FREE = {"min_linear_vel": -math.inf, "max_linear_vel": math.inf, "max_angular_vel": math.inf}
PATH = named_path("lissajous")


def finished(work):
    """Return what a generator returns."""
    while True:
        try:
            next(work)
        except StopIteration as end:
            return end.value


def model_of(chosen, path=PATH):
    return MotionModel(chosen, steady_schedule(path, chosen.target, chosen.cost))


def driven(model, policy, start):
    return finished(model.driven(policy, 0.0, start, 1.0))


def straight_on(model):
    """Return the policy that does as if it were on the path."""
    return lambda time, state, held: model.limited(np.zeros(2), state[3])


def far_policy(chosen):
    region = WideRegion(chosen, steady_schedule(PATH, chosen.target, chosen.cost))
    return lambda time, state, held: region.driven_input(state)


def improved(model, motion, part=1.0, most=math.inf):
    """Return the motion of the best inputs about a motion, None if it costs too much."""
    found = finished(model.improved(motion, part, 1.0))

    def policy(time, state, held):
        return model.limited(found.input(time, state, held), state[3])

    return finished(model.driven(policy, 0.0, motion.start, 1.0, most))


def converged(model, motion):
    """Return the motion that no improvement makes cheaper, as Newton's method with halving does."""
    part = 1.0
    while part > 1e-4:
        other = improved(model, motion, part, motion.cost * (1.0 - 1e-12))
        motion, part = (motion, 0.5 * part) if other is None else (other, min(1.0, 2.0 * part))
    return motion


def with_changed_input(model, motion, number, change):
    """Return J of a motion with another input in one step."""
    inputs = motion.inputs.copy()
    inputs[number] += change
    rows = iter(inputs)
    return driven(model, lambda time, state, held: next(rows), motion.start).cost


@settings(max_examples=10)
@given(
    s=st.floats(-1.5, 1.5),
    y=st.floats(-1.5, 1.5),
    theta=st.floats(-1.5, 1.5),
    place=st.floats(0.0, 24.0),
    limits=st.sampled_from([{}, FREE]),
)
def test_no_change_of_an_input_makes_the_best_motion_cheaper(s, y, theta, place, limits):
    """Within the limits the cost's slope is 0, and at a limit it points outwards."""
    chosen = build(Settings, limits)
    model = model_of(chosen)
    motion = converged(model, driven(model, far_policy(chosen), (s, y, theta, place)))
    middles = 0.5 * (motion.states[:-1, 3] + motion.states[1:, 3])
    for number in (0, 3, 10, 20, 30):
        for axis in np.eye(2):
            costs = [
                with_changed_input(model, motion, number, sign * 1e-4 * axis)
                for sign in (-1.0, 1.0)
            ]
            slope = (costs[1] - costs[0]) / 2e-4
            steady = 0.5 * np.array([1.0, float(PATH.curvature(middles[number]))])
            command, index = motion.inputs[number] + steady, int(axis[1])
            if abs(command[index] - chosen.limits.lower[index]) < 0.02:
                assert slope > -0.02 * motion.cost
            elif abs(command[index] - chosen.limits.upper[index]) < 0.02:
                assert slope < 0.02 * motion.cost
            else:
                assert abs(slope) < 2e-3 * max(motion.cost, 0.1)


@pytest.mark.parametrize("kappa", [0.0, 0.6])
@pytest.mark.parametrize("speed", [0.2, 0.5])
def test_on_a_circle_the_gains_are_those_of_the_riccati_solution(kappa, speed):
    chosen = build(Settings, {"desired_speed": speed, **FREE})
    model = model_of(chosen, circle(kappa) if kappa else named_path("line"))
    motion = driven(model, straight_on(model), (0.0, 0.0, 0.0, 0.0))
    found = finished(model.improved(motion, 1.0, 1.0))
    matrix = riccati_solution(kappa, speed, chosen.target, chosen.cost)
    wanted = -chosen.cost.inverse_input_cost() @ INPUT_MATRIX.T @ matrix
    steady = found.input(0.0, (0.0, 0.0, 0.0, 0.0), 0.0)
    np.testing.assert_allclose(steady, 0.0, atol=1e-9)
    for axis in range(3):
        state = tuple(1e-3 * np.eye(4)[axis])
        # Held for 40 ms, which costs a few percent of the gain.
        gain = (found.input(0.0, state, 0.0) - steady) * 1e3
        np.testing.assert_allclose(gain, wanted[:, axis], rtol=0.06, atol=0.02)


@settings(max_examples=20)
@given(
    s=st.floats(-4.0, 4.0),
    y=st.floats(-4.0, 4.0),
    theta=st.floats(-3.1, 3.1),
    part=st.floats(0.1, 1.0),
)
def test_inputs_stay_within_the_limits(s, y, theta, part):
    chosen = build(Settings, {})
    model = model_of(chosen)
    motion = improved(model, driven(model, straight_on(model), (s, y, theta, BEND)), part)
    for u, place in zip(motion.inputs, motion.states[:-1, 3].tolist(), strict=True):
        command = u + 0.5 * np.array([1.0, float(PATH.curvature(place))])
        assert (command > chosen.limits.lower - 1e-9).all()
        assert (command < chosen.limits.upper + 1e-9).all()


class Robot:
    """An ideal robot before the bend, and its follower."""

    def __init__(self, error, path=PATH, **values):
        self.follower = PathFollower(build(Settings, values), path, BEND)
        self.pose = pose_in_frame(np.array(error), path.frame(BEND).pose)

    def drive(self, steps):
        """Return what each of some steps of 10 ms gave."""
        outputs = []
        for _ in range(steps):
            outputs.append(self.follower.step(self.pose, 0.01))
            self.pose = advance_pose(self.pose, *outputs[-1].command.tolist(), 0.01)
        return outputs


def test_a_robot_that_is_carried_goes_on_with_the_far_policy_without_a_step():
    """The command changes as much as the far policy's would, and the path is reached."""
    robot = Robot([2.0, -2.5, 0.4], learning=False)
    robot.drive(100)
    robot.pose = robot.pose + np.array([-0.5, 0.6, 0.3])
    commands = np.array([output.command for output in robot.drive(1500)])
    assert np.abs(np.diff(commands[5:], axis=0)).max() < 0.1
    assert np.abs(robot.drive(1)[0].error).max() < 0.02


def test_commands_do_not_jump_where_an_improved_policy_takes_over():
    """From so far away that the far policy begins, and is left, taken and left again."""
    outputs = Robot([2.0, -6.5, 0.4]).drive(900)
    jumps = np.abs(np.diff([output.command for output in outputs], axis=0)).max(axis=0)
    assert (jumps < [0.15, 0.3]).all()  # 0.59 rad/s without easing


def test_many_robots_take_the_way_of_each_alone():
    """Each has a lookahead of its own, whichever of the others are far from the path."""
    chosen = build(Settings, {"learning": False})
    errors = np.array([[2.0, -2.9, -0.5], [0.1, 0.0, 0.1], [-4.5, -3.2, 3.0], [1.0, -2.6, -0.7]])
    poses = pose_in_frame(errors, PATH.frame(BEND).pose)
    together = PathFollower(chosen, PATH, np.full(4, BEND))
    square = PathFollower(chosen, PATH, np.full((2, 2), BEND))
    alone = [PathFollower(chosen, PATH, BEND) for _ in errors]
    for _ in range(150):
        commands = together.step(poses, 0.01).command
        each = [one.step(pose, 0.01).command for one, pose in zip(alone, poses, strict=True)]
        np.testing.assert_allclose(each, commands, rtol=1e-6, atol=1e-6)
        in_rows = square.step(poses.reshape(2, 2, 3), 0.01).command
        np.testing.assert_allclose(in_rows.reshape(4, 2), commands, rtol=1e-9, atol=1e-9)
        poses = advance_pose(poses, commands[:, 0], commands[:, 1], 0.01)


@pytest.mark.parametrize(("name", "improves"), [("lissajous", True), ("line", False)])
def test_a_path_of_one_curvature_needs_no_lookahead(name, improves):
    chosen, path = build(Settings, {}), named_path(name)
    far = FarFromPath(chosen, steady_schedule(path, chosen.target, chosen.cost))
    zeta, steady = np.array([2.0, -2.9, -0.5, 0.5]), np.array([0.5, 0.0])
    place = np.float64(BEND), zeta, path.curvature(BEND), steady
    as_before = far.region.far_input(*place)
    assert (far.far_input(0.0, *place).tolist() != as_before.tolist()) == improves
