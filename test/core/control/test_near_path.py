"""A robot that is not ideal is held on its path more strictly than the cost asks for."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from adp_path_follower.core.control.error_dynamics import feedforward
from adp_path_follower.core.control.near_path import NearPath
from adp_path_follower.core.control.riccati import (
    INPUT_MATRIX,
    RiccatiSchedule,
    riccati_solution,
    system_matrix,
)
from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.geometry import advance_pose
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.path.speed_profile import SpeedProfile
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

CURVATURE = 0.5
TURNED = [1.0, 0.1, 0.1, 2.0]  # a cost of the inputs that couples them


def parts(**values):
    tuning, path = build(Settings, values), named_path(f"circle:{CURVATURE}")
    riccati = RiccatiSchedule(path, tuning.target, tuning.cost, SpeedProfile(path, tuning))
    return tuning, NearPath(tuning, riccati)


def solution(tuning, least):
    """Return P with a cost of y of at least so much, by scipy."""
    state_cost, input_cost = tuning.cost.state_cost_matrix(), tuning.cost.input_cost_matrix()
    state_cost[1, 1] = max(state_cost[1, 1], least)
    system = system_matrix(CURVATURE, tuning.target, tuning.target.desired_speed)
    return solve_continuous_are(system, INPUT_MATRIX, state_cost, input_cost)


@pytest.mark.parametrize("input_cost", [[1.0, 2.0], [1.0, 0.1, 0.1, 2.0]])
@pytest.mark.parametrize("error", [(0.004, -0.003), (-0.006, -0.002)])
def test_close_to_the_path_it_turns_as_the_larger_cost_asks_for(input_cost, error):
    tuning, near = parts(input_cost=input_cost)
    zeta, fed = np.array([0.3, *error, 0.0]), feedforward(np.array(CURVATURE), 0.5)
    added = near.held(np.zeros(2), zeta, np.array(CURVATURE), fed)
    more = solution(tuning, 240.0) - solution(tuning, 1.0)  # 120 R_ww
    wanted = np.linalg.solve(tuning.cost.input_cost_matrix(), [0.0, more[2, 1:] @ error])
    np.testing.assert_allclose(added, -wanted, rtol=2e-3, atol=1e-7)


def test_a_cost_that_is_larger_already_is_left_alone():
    _, near = parts(state_cost=[1.0, 140.0, 1.0])
    zeta, u = np.array([0.1, 0.005, 0.003, 0.0]), np.array([0.1, -0.2])
    fed = feedforward(np.array(CURVATURE), 0.5)
    np.testing.assert_allclose(near.held(u, zeta, np.array(CURVATURE), fed), u, atol=1e-15)


def test_farther_away_it_fades():
    tuning, near = parts()
    fed = np.tile(feedforward(np.array(CURVATURE), 0.5), (3, 1))
    way = np.array([0.3, 0.8, -0.6, 0.0])
    zeta = np.array([0.01, 0.2, 1.0])[:, None] * way
    added = near.held(np.zeros((3, 2)), zeta, np.full(3, CURVATURE), fed)
    expected = added[0] / np.array([[1.0], [20.0], [100.0]])
    np.testing.assert_allclose(added, expected, rtol=1e-12)
    assert np.abs(added[0]).max() > 0.01
    hard = near.held(np.full((3, 2), 9.0), zeta, np.full(3, CURVATURE), fed)
    assert (hard + fed <= tuning.limits.upper + 1e-12).all()


@pytest.mark.parametrize("tight_within", [0.0, 0.01])
def test_what_pushes_it_aside_leaves_it_where_the_gain_says(tight_within):
    """At rest beside a line, K_y y is the turn rate that the model does not know."""
    tuning = build(Settings, {"robot_model": "learned", "tight_within": tight_within})
    unknown = 0.02  # [rad/s]
    follower = PathFollower(tuning, named_path("line"))
    follower.law.robot_is_ideal = False
    pose = np.array([0.0, 0.0, 0.0])
    for _ in range(3000):
        v, w = follower.step(pose, 0.01).command
        pose = advance_pose(pose, v, w + unknown, 0.01)
    cost = tuning.cost
    if tight_within:
        cost = dataclasses.replace(cost, state_cost=(1.0, 120.0, 1.0))
    gain = riccati_solution(0.0, tuning.target.desired_speed, tuning.target, cost)[2, 1]
    assert pose[1] == pytest.approx(unknown / gain, rel=0.02)


def test_an_ideal_robot_never_feels_it():
    found = []
    for tight_within in (0.0, 0.01):
        tuning = build(Settings, {"tight_within": tight_within})
        follower = PathFollower(tuning, named_path("line"))
        pose, commands = np.array([0.0, 0.005, 0.0]), []
        for _ in range(300):
            commands.append(follower.step(pose, 0.01).command)
            pose = advance_pose(pose, *commands[-1], 0.01)
        found.append(np.array(commands))
    np.testing.assert_array_equal(*found)
