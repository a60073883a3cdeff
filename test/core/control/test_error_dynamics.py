"""The error dynamics against the motion of robot and target in the world."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.integrate import solve_ivp

from adp_path_follower.core.control import error_dynamics as dynamics
from adp_path_follower.core.geometry import advance_pose, pose_in_frame, tracking_error
from adp_path_follower.core.path.library import circle, lissajous
from adp_path_follower.core.settings.groups import TargetSettings

PATHS = {"figure eight": lissajous(), "left": circle(1.0), "right": circle(-0.4)}

targets = st.builds(
    TargetSettings,
    desired_speed=st.floats(0.01, 3.0),
    target_gain=st.floats(0.01, 5.0),
    path_state_gain=st.floats(0.001, 1.0),
)
lengths = st.floats(-3.0, 3.0)
angles = st.floats(-math.pi + 0.01, math.pi - 0.01)
errors = st.tuples(lengths, lengths, angles).map(np.array)


def rate(zeta, curvature, modified_input, target):
    """Return f + g u."""
    gain = dynamics.input_matrix(zeta)
    drift = dynamics.drift(zeta, curvature, target, target.desired_speed)
    return drift + (gain @ modified_input[..., None])[..., 0]


@settings(max_examples=150)
@given(
    name=st.sampled_from(sorted(PATHS)),
    place=st.floats(0.0, 1.0),
    error=errors,
    twist=st.tuples(st.floats(-2.0, 2.0), st.floats(-3.0, 3.0)).map(np.array),
    target=targets,
)
def test_the_error_moves_as_robot_and_target_do(name, place, error, twist, target):
    path = PATHS[name]
    s_p = place * path.length
    frame = path.frame(s_p)
    pose = pose_in_frame(error, frame.pose)
    speed = target.desired_speed * math.cos(error[2]) + target.target_gain * error[0]

    def zeta_at(time):
        moved = advance_pose(pose, twist[0], twist[1], time)
        there = s_p + speed * time
        seen = tracking_error(moved, path.frame(there).pose)
        return np.append(seen, math.tanh(target.path_state_gain * there))

    h = 2e-5
    measured = (zeta_at(h) - zeta_at(-h)) / (2.0 * h)
    zeta = np.append(error, math.tanh(target.path_state_gain * s_p))
    steady = np.array([target.desired_speed, float(frame.curvature) * target.desired_speed])
    predicted = rate(zeta, frame.curvature, twist - steady, target)
    np.testing.assert_allclose(predicted, measured, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("name", sorted(PATHS))
def test_integrated_error_dynamics_agree_with_the_world(name):
    path, target = PATHS[name], TargetSettings(desired_speed=0.5, target_gain=0.1)
    random = np.random.default_rng(7)
    count = 200
    error = random.uniform([-1.0, -1.0, -2.0], [1.0, 1.0, 2.0], (count, 3))
    held = random.uniform([-0.4, -0.5], [0.4, 0.5], (count, 2))
    s_p = random.uniform(0.0, path.length, count)
    phi = np.tanh(target.path_state_gain * s_p)
    v_des, k1 = target.desired_speed, target.target_gain

    def error_rate(_, flat):
        state = flat.reshape(5, count).T
        kappa = path.curvature(state[:, 4])
        zeta_rate = rate(state[:, :4], kappa, held, target)
        speed = v_des * np.cos(state[:, 2]) + k1 * state[:, 0]
        return np.column_stack([zeta_rate, speed]).T.ravel()

    def world_rate(_, flat):
        x, y, theta, place = flat.reshape(4, count)
        frame = path.frame(place)
        target_x, target_y, heading = frame.pose.T
        along = np.cos(heading) * (x - target_x) + np.sin(heading) * (y - target_y)
        v = v_des + held[:, 0]
        w = frame.curvature * v_des + held[:, 1]
        speed = v_des * np.cos(theta - heading) + k1 * along
        return np.concatenate([v * np.cos(theta), v * np.sin(theta), w, speed])

    options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}  # they differ by 1e-8
    start = np.column_stack([error, phi, s_p]).T.ravel()
    of_errors = solve_ivp(error_rate, (0.0, 5.0), start, **options).y[:, -1].reshape(5, count).T
    pose = pose_in_frame(error, path.frame(s_p).pose)
    start = np.column_stack([pose, s_p]).T.ravel()
    in_world = solve_ivp(world_rate, (0.0, 5.0), start, **options).y[:, -1].reshape(4, count).T

    np.testing.assert_allclose(of_errors[:, 4], in_world[:, 3], atol=1e-6)
    seen = tracking_error(in_world[:, :3], path.frame(in_world[:, 3]).pose)
    np.testing.assert_allclose(of_errors[:, :2], seen[:, :2], atol=1e-6)
    turn = np.angle(np.exp(1j * (of_errors[:, 2] - seen[:, 2])))
    np.testing.assert_allclose(turn, 0.0, atol=1e-6)
    expected_phi = np.tanh(target.path_state_gain * in_world[:, 3])
    np.testing.assert_allclose(of_errors[:, 3], expected_phi, atol=1e-8)


@settings(max_examples=150)
@given(
    zeta=npst.arrays(float, 4, elements=st.floats(-1.0, 1.0)),
    scale=st.floats(0.1, 50.0),
    kappa=st.floats(-5.0, 5.0),
)
def test_drift_is_the_printed_one_row_by_row(printed, zeta, scale, kappa):
    zeta[:2] *= scale
    target = TargetSettings(printed.v_des, printed.k1, printed.k2)
    found = dynamics.drift(zeta, np.array(kappa), target, target.desired_speed)
    size = 1.0 + abs(kappa) * scale**2
    for row, expected in enumerate(printed.drift(zeta, kappa)):
        assert found[row] == pytest.approx(expected, rel=1e-12, abs=1e-13 * size)
    np.testing.assert_array_equal(dynamics.input_matrix(zeta), printed.input_matrix(zeta))


@settings(max_examples=60)
@given(
    zeta=npst.arrays(float, (2, 3, 4), elements=st.floats(-1.0, 1.0)),
    kappa=npst.arrays(float, (2, 3), elements=st.floats(-5.0, 5.0)),
    target=targets,
)
def test_a_batch_of_states_is_as_single_ones(zeta, kappa, target):
    drift = dynamics.drift(zeta, kappa, target, target.desired_speed)
    gain = dynamics.input_matrix(zeta)
    steady = dynamics.feedforward(kappa, target.desired_speed)
    assert drift.shape == (2, 3, 4)
    assert gain.shape == (2, 3, 4, 2)
    assert steady.shape == (2, 3, 2)
    for index in np.ndindex(2, 3):
        single = dynamics.drift(zeta[index], kappa[index], target, target.desired_speed)
        np.testing.assert_allclose(drift[index], single, rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(gain[index], dynamics.input_matrix(zeta[index]), atol=1e-15)
        v_des = target.desired_speed
        np.testing.assert_allclose(steady[index], [v_des, v_des * kappa[index]], rtol=1e-15)


@settings(max_examples=60)
@given(kappa=st.floats(-5.0, 5.0), phi=st.floats(-0.99, 0.99), target=targets)
def test_a_robot_on_the_target_stays_there_without_input(kappa, phi, target):
    zeta = np.array([0.0, 0.0, 0.0, phi])
    drift = dynamics.drift(zeta, np.array(kappa), target, target.desired_speed)
    np.testing.assert_array_equal(drift[:3], 0.0)
    expected = target.path_state_gain * (1.0 - phi**2) * target.desired_speed
    assert drift[3] == pytest.approx(expected)


def test_feedforward_alone_keeps_a_robot_on_the_figure_eight(figure_eight):
    target = TargetSettings()

    def world_rate(time, pose):
        s_p = np.array(target.desired_speed * time)
        v, w = dynamics.feedforward(figure_eight.curvature(s_p), target.desired_speed)
        return [v * math.cos(pose[2]), v * math.sin(pose[2]), w]

    start = figure_eight.frame(0.0).pose
    solution = solve_ivp(world_rate, (0.0, 40.0), start, method="DOP853", rtol=1e-10, atol=1e-10)
    there = figure_eight.frame(40.0 * target.desired_speed).pose
    np.testing.assert_allclose(tracking_error(solution.y[:, -1], there), 0.0, atol=1e-5)


@settings(max_examples=100)
@given(s_p=st.floats(-20.0, 20.0), error=errors, target=targets)
def test_phi_is_the_tanh_of_arc_length_and_moves_as_it_does(s_p, error, target):
    phi = float(dynamics.path_state(np.array(s_p), target))
    assert phi == pytest.approx(math.tanh(target.path_state_gain * s_p), abs=1e-15)
    speed = target.desired_speed * math.cos(error[2]) + target.target_gain * error[0]
    assert float(dynamics.target_speed(error, target, target.desired_speed)) == pytest.approx(
        speed, abs=1e-14
    )
    h = 1e-4
    ahead, behind = (math.tanh(target.path_state_gain * (s_p + d * speed)) for d in (h, -h))
    rate_of_phi = dynamics.drift(
        np.append(error, phi), np.array(0.3), target, target.desired_speed
    )[3]
    assert rate_of_phi == pytest.approx((ahead - behind) / (2.0 * h), rel=1e-5, abs=1e-7)


@settings(max_examples=60)
@given(phi=st.floats(-0.999, 0.999), target=targets)
def test_arc_length_of_phi_is_its_inverse(phi, target):
    s_p = float(dynamics.arc_length_of(np.array(phi), target))
    assert math.tanh(target.path_state_gain * s_p) == pytest.approx(phi, abs=1e-14)
