"""Poses and angles against integration, complex numbers and math.remainder."""

import cmath
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from adp_path_follower.core.geometry import (
    advance_pose,
    clamped,
    components,
    contiguous,
    cos,
    numbers,
    pose_in_frame,
    sin,
    tanh,
    tracking_error,
    where,
    wrap_angle,
    yaw_of_quaternion,
)

places = st.floats(-20.0, 20.0)
headings = st.floats(-10.0, 10.0)
tiny_rates = st.sampled_from([0.0, 5e-324, 1e-300, 1e-12, -1e-9, 1e-8, -1e-6, 1e-4])
rates = st.one_of(st.floats(-5.0, 5.0), tiny_rates)


@settings(max_examples=60)
@given(
    pose=st.tuples(places, places, headings),
    linear=st.floats(-3.0, 3.0),
    angular=rates,
    dt=st.floats(0.0, 4.0),
)
def test_advance_pose_is_the_solution_of_the_unicycle(pose, linear, angular, dt):
    solution = solve_ivp(
        lambda _, p: [linear * math.cos(p[2]), linear * math.sin(p[2]), angular],
        (0.0, dt),
        pose,
        method="DOP853",
        rtol=1e-11,
        atol=1e-12,
    )
    moved = advance_pose(np.array(pose), linear, angular, dt)
    np.testing.assert_allclose(moved, solution.y[:, -1], atol=1e-8)


@settings(max_examples=60)
@given(
    pose=st.tuples(places, places, headings),
    linear=st.floats(-3.0, 3.0),
    angular=rates,
    first=st.floats(0.0, 2.0),
    second=st.floats(0.0, 2.0),
)
def test_two_periods_of_a_held_twist_are_one_long_one(pose, linear, angular, first, second):
    start = np.array(pose)
    halfway = advance_pose(start, linear, angular, first)
    both = advance_pose(halfway, linear, angular, second)
    at_once = advance_pose(start, linear, angular, first + second)
    np.testing.assert_allclose(both, at_once, atol=1e-12)


@settings(max_examples=50)
@given(
    poses=npst.arrays(float, (2, 3, 3), elements=headings),
    twists=npst.arrays(float, (2, 3, 2), elements=rates),
    dt=st.floats(0.0, 1.0),
)
def test_a_batch_of_poses_moves_as_single_ones_do(poses, twists, dt):
    moved = advance_pose(poses, twists[..., 0], twists[..., 1], dt)
    assert moved.shape == poses.shape
    for index in np.ndindex(2, 3):
        single = advance_pose(poses[index], twists[index][0], twists[index][1], dt)
        np.testing.assert_allclose(moved[index], single, rtol=0.0, atol=1e-13)


@settings(max_examples=200)
@given(angle=st.floats(-1e6, 1e6))
@example(angle=-math.pi)
@example(angle=math.pi)
@example(angle=float(np.nextafter(-math.pi, -4.0)))
@example(angle=float(np.nextafter(math.pi, 0.0)))
@example(angle=-3.0 * math.pi)
@example(angle=-5e-324)
def test_wrapped_angles_are_in_range_and_the_same_direction(angle):
    wrapped = float(wrap_angle(angle))
    assert -math.pi <= wrapped < math.pi
    assert abs(math.remainder(wrapped - angle, math.tau)) < 1e-9


@settings(max_examples=50)
@given(angles=npst.arrays(float, npst.array_shapes(max_dims=3), elements=st.floats(-1e3, 1e3)))
def test_wrapping_keeps_the_shape_and_each_direction(angles):
    wrapped = wrap_angle(angles)
    assert wrapped.shape == angles.shape
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-9)


@settings(max_examples=100)
@given(
    frame=st.tuples(places, places, headings),
    error=st.tuples(places, places, st.floats(-math.pi + 1e-6, math.pi - 1e-6)),
)
def test_pose_in_frame_is_the_inverse_of_tracking_error(frame, error):
    frame_pose, expected = np.array(frame), np.array(error)
    pose = pose_in_frame(expected, frame_pose)
    turn = cmath.exp(1j * frame[2])
    place = complex(frame[0], frame[1]) + turn * complex(error[0], error[1])
    np.testing.assert_allclose(pose, [place.real, place.imag, frame[2] + error[2]], atol=1e-12)
    np.testing.assert_allclose(tracking_error(pose, frame_pose), expected, atol=1e-9)


def test_a_vehicle_to_the_left_and_ahead_has_positive_errors():
    north = np.array([3.0, -1.0, math.pi / 2.0])
    pose = np.array([2.5, 1.0, math.pi / 2.0 + 0.25])
    np.testing.assert_allclose(tracking_error(pose, north), [2.0, 0.5, 0.25], atol=1e-15)


@settings(max_examples=100)
@given(yaw=st.floats(-3.14, 3.14), scale=st.floats(0.01, 100.0))
def test_yaw_of_a_turned_robot_does_not_depend_on_the_quaternions_norm(yaw, scale):
    z, w = scale * math.sin(yaw / 2.0), scale * math.cos(yaw / 2.0)
    assert math.isclose(yaw_of_quaternion(0.0, 0.0, z, w), yaw, abs_tol=1e-12)


@settings(max_examples=100)
@given(yaw=st.floats(-3.0, 3.0), pitch=st.floats(-1.4, 1.4), roll=st.floats(-3.0, 3.0))
def test_yaw_of_a_tilted_robot_is_the_direction_of_its_nose(yaw, pitch, roll):
    rotation = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    nose = rotation.apply([1.0, 0.0, 0.0])
    expected = math.atan2(nose[1], nose[0])
    found = yaw_of_quaternion(*rotation.as_quat())
    assert abs(math.remainder(found - expected, math.tau)) < 1e-9


@pytest.mark.filterwarnings("ignore:invalid value")  # numpy's, of what is infinite
@settings(max_examples=200)
@given(value=st.floats(), low=rates, width=st.floats(0.0, 5.0))
def test_functions_of_one_number_are_those_of_arrays(value, low, width):
    for one in (value, np.float64(value)):
        for ours, theirs in ((cos, np.cos), (sin, np.sin), (tanh, np.tanh)):
            np.testing.assert_allclose(ours(one), theirs(np.array([one]))[0], rtol=1e-14)
            np.testing.assert_array_equal(ours(np.array([one])), theirs(np.array([one])))
        expected = np.clip(np.array([one]), low, low + width)
        np.testing.assert_array_equal(clamped(one, low, low + width), expected[0])
        np.testing.assert_array_equal(clamped(np.array([one]), low, low + width), expected)
        condition = one > low
        np.testing.assert_array_equal(where(condition, one, low), np.where(condition, one, low))
        array = np.array([one]) > low
        np.testing.assert_array_equal(where(array, one, low), np.where(array, one, low))


@settings(max_examples=50)
@given(several=npst.arrays(float, (3, 4), elements=rates))
def test_numbers_are_the_components_along_the_last_axis(several):
    np.testing.assert_array_equal(np.stack(numbers(several)), several.T)
    for row in several:
        assert all(type(number) is float for number in numbers(row))
        np.testing.assert_array_equal(numbers(row), row)
        np.testing.assert_array_equal(components(*numbers(row)), row)


@pytest.mark.parametrize("count", [1, 2, 5])
def test_components_computed_with_lie_side_by_side(count):
    # numpy calls an array of one number contiguous whatever its stride is.
    apart = np.ones((count, 6))[..., 1]
    copy = contiguous(apart)
    assert copy.strides == (copy.itemsize,)
    assert not np.shares_memory(copy, apart)
