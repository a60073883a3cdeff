"""The speed along a path against closed forms, and against integrated motion."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import circle, lissajous, named_path, path_through
from adp_path_follower.core.path.speed_profile import (
    SHARE,
    SpeedProfile,
    SpeedReference,
    passing_times,
    speed_from_rest,
)
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

EIGHT = lissajous()
LINE = named_path("line")
BEND = Path.from_points(  # 3 m straight on, a quarter of a circle of 0.5 m, 3 m straight on
    [
        *([x, 0.0] for x in np.linspace(0.0, 3.0, 121)),
        *(
            [3.0 + 0.5 * math.sin(angle), 0.5 - 0.5 * math.cos(angle)]
            for angle in np.linspace(0.0, 0.5 * math.pi, 33)[1:]
        ),
        *([3.5, y] for y in np.linspace(0.5, 3.5, 121)[1:]),
    ]
)


def test_times_and_speeds_from_rest_are_those_of_a_constant_acceleration():
    values = {"max_linear_accel": 1.0, "max_linear_vel": 5.0, "desired_speed": 2.0}
    reference = speed_from_rest(LINE, build(Settings, values), 3.0)
    slowest = reference.profile.slowest
    # v^2 = slowest^2 + 2 a run: v grows by a each second.
    places = 3.0 + np.linspace(0.0, 2.0, 50)
    times = passing_times(reference, places)
    np.testing.assert_allclose(reference.speed(places), slowest + SHARE * times, rtol=1e-9)
    apart = SpeedReference(reference.profile, build(Settings, values))
    apart.launch(np.array([3.0, 7.0]), np.array([0.0, 1.0]))
    assert apart.of_robot(0).speed(places) == pytest.approx(reference.speed(places))
    assert apart.of_robot(1).speed(np.array(7.0)) == pytest.approx(1.0)


def profile_of(path, **values):
    return SpeedProfile(path, build(Settings, values))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("path", [EIGHT, LINE, BEND], ids=["eight", "line", "bend"])
def test_limits_beyond_any_robot_are_none(path):
    names = ("max_linear_accel", "max_angular_accel", "max_lateral_accel", "max_angular_vel")
    profile = profile_of(path, **dict.fromkeys(names, 1.7e308))
    places = np.linspace(0.0, path.length, 500)
    np.testing.assert_allclose(profile.speed(places), 0.5, rtol=1e-9)


@pytest.mark.parametrize("path", [EIGHT, LINE, circle(-1.0)], ids=["eight", "line", "circle"])
def test_without_limits_that_bind_it_is_the_desired_speed(path):
    profile = profile_of(path)
    assert not profile.varies
    assert not profile.stops
    assert np.all(profile.speed(np.linspace(-3.0, path.length + 3.0, 999)) == 0.5)
    # Nor do accelerations change anything on a closed path that is gentle enough.
    limits = {"max_linear_accel": 1.0, "max_linear_decel": 1.0, "max_angular_accel": 3.0}
    assert path is LINE or not profile_of(path, **limits).varies


@settings(max_examples=50)
@given(speed=st.floats(0.1, 3.0), decel=st.floats(0.05, 5.0), left=st.floats(0.0, 20.0))
def test_the_end_of_a_line_is_braked_to_from_the_braking_distance(speed, decel, left):
    profile = profile_of(LINE, desired_speed=speed, max_linear_vel=5.0, max_linear_decel=decel)
    assert profile.stops
    found = float(profile.speed(np.asarray(LINE.length - left)))

    def braked(left):
        return np.minimum(speed**2, 2.0 * SHARE * decel * left)

    # Squares, for a place near 100 m is rounded to 1e-14 m, of which the root makes 4e-7 m/s.
    assert found**2 <= braked(left) + 1e-12
    nodes = np.linspace(0.0, LINE.length, round(LINE.length / 0.02) + 1)
    assert found**2 == pytest.approx(np.interp(left, nodes, braked(nodes)), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"max_lateral_accel": 0.1}, math.sqrt(0.1 / 2.0)),
        ({"max_angular_vel": 0.6}, SHARE * 0.6 / 2.0),
        ({"speed_limit": 0.2}, 0.2),
        ({"max_linear_vel": 0.3}, 0.3),
        ({"desired_speed": 0.1, "max_lateral_accel": 0.1}, 0.1),
    ],
)
def test_on_a_circle_the_tightest_limit_holds(values, expected):
    profile = profile_of(circle(2.0), **values)
    assert profile.speed(np.linspace(-9.0, 9.0, 99)) == pytest.approx(expected, rel=1e-3)


def test_it_brakes_before_a_bend_and_accelerates_after_it():
    accel, decel, lateral = 0.3, 0.2, 0.1
    profile = profile_of(
        BEND, max_linear_accel=accel, max_linear_decel=decel, max_lateral_accel=lateral
    )
    inside = math.sqrt(lateral * 0.5)
    middle = 3.0 + 0.125 * math.pi
    assert float(profile.speed(np.asarray(middle))) == pytest.approx(inside, rel=0.01)
    for before in (0.1, 0.3):
        expected = math.sqrt(inside**2 + 2.0 * SHARE * decel * before)
        found = float(profile.speed(np.asarray(3.0 - before)))
        assert found == pytest.approx(min(0.5, expected), rel=0.05)
    after = 3.0 + 0.25 * math.pi
    expected = math.sqrt(inside**2 + 2.0 * SHARE * accel * 0.1)
    assert float(profile.speed(np.asarray(after + 0.1))) == pytest.approx(expected, rel=0.05)
    assert float(profile.speed(np.asarray(1.0))) == 0.5


@settings(max_examples=25)
@given(
    accel=st.floats(0.1, 3.0),
    decel=st.floats(0.1, 3.0),
    lateral=st.floats(0.02, 1.0),
    turn=st.floats(0.2, 2.0),
    turn_accel=st.floats(0.3, 5.0),
    path=st.sampled_from([EIGHT, BEND, circle(1.5)]),
)
def test_a_robot_that_keeps_to_it_keeps_every_limit(accel, decel, lateral, turn, turn_accel, path):
    profile = profile_of(
        path,
        max_linear_accel=accel,
        max_linear_decel=decel,
        max_lateral_accel=lateral,
        max_angular_vel=turn,
        max_angular_accel=turn_accel,
    )
    place = np.linspace(0.0, path.length, 20_001)
    v, kappa = np.broadcast_to(profile.speed(place), place.shape), path.curvature(place)
    along = np.diff(v**2) / (2.0 * np.diff(place))  # a = v dv/ds
    assert along.max() <= SHARE * accel * (1.0 + 1e-6) + 1e-9
    assert along.min() >= -SHARE * decel * (1.0 + 1e-6) - 1e-9
    assert (v**2 * np.abs(kappa)).max() <= lateral * 1.1  # curvature is sampled every 20 mm
    assert np.abs(v * kappa).max() <= turn
    if path is not BEND:  # whose curvature jumps
        middle = 0.5 * (v[1:] + v[:-1])
        assert np.abs(np.diff(v * kappa) / np.diff(place) * middle).max() <= turn_accel


def test_it_comes_round_on_a_closed_path():
    profile = profile_of(EIGHT, max_linear_accel=0.1, max_linear_decel=0.05, max_lateral_accel=0.05)
    place = np.linspace(0.0, EIGHT.length, 500)
    np.testing.assert_allclose(profile.speed(place), profile.speed(place + 3.0 * EIGHT.length))
    seam = profile.speed(np.array([-1e-6, 0.0, 1e-6]))
    assert np.ptp(seam) < 1e-5


def test_models_take_no_speed_for_zero():
    profile = profile_of(LINE, max_linear_decel=1.0)
    assert float(profile.speed(np.asarray(LINE.length))) == 0.0
    assert float(profile.model_speed(np.asarray(LINE.length))) == 0.05
    assert profile_of(LINE, desired_speed=0.04).slowest == pytest.approx(0.01)


@pytest.mark.parametrize("begin", [0.0, 0.2, 0.9])
def test_it_is_reached_from_the_robots_speed_with_its_accelerations(begin):
    tuning = build(Settings, {"max_linear_accel": 0.4, "max_linear_decel": 0.25})
    reference = SpeedReference(SpeedProfile(LINE, tuning), tuning)
    reference.launch(np.asarray(7.0), np.asarray(begin))
    for run in (0.0, 0.1, 0.3, 2.0):
        found = float(reference.speed(np.asarray(7.0 + run)))
        if begin > 0.5:
            expected = max(0.5, math.sqrt(max(begin**2 - 2.0 * SHARE * 0.25 * run, 0.0)))
        else:
            expected = min(0.5, math.sqrt(max(begin, 0.05) ** 2 + 2.0 * SHARE * 0.4 * run))
        assert found == pytest.approx(expected, rel=1e-12)


def test_nothing_is_to_be_reached_where_accelerations_have_no_limit():
    tuning = build(Settings, {})
    reference = SpeedReference(SpeedProfile(LINE, tuning), tuning)
    reference.launch(np.asarray(7.0), np.asarray(0.0))
    assert reference.speed(np.asarray(7.0)) == tuning.target.desired_speed


@pytest.mark.parametrize(("fastest", "share"), [(0.5, 1.0), (1.0, 0.7)])
def test_a_robot_that_changes_its_speed_slowly_brakes_before_a_bend(fastest, share):
    tuning = build(Settings, {"max_lateral_accel": 0.1, "max_linear_vel": fastest})
    ramp = 0.4  # where it may be faster, part of it is for the turn
    reference = SpeedReference(SpeedProfile(BEND, tuning), tuning)
    place = np.linspace(2.5, 2.95, 10)
    before = reference.speed(place)
    reference.keep_within(ramp)
    highest = np.sqrt(0.1 * 0.5 + 2.0 * SHARE * share * ramp * (3.0 - place))
    found = reference.speed(place)
    assert (found <= 1.03 * highest).all()
    late = highest < 0.45  # no time to make good what is about to be lost
    np.testing.assert_allclose(found[late], highest[late], rtol=0.06)
    assert not reference.stops  # at the end of the path
    reference.keep_within(1.05 * ramp)
    np.testing.assert_array_equal(reference.speed(place), found)
    reference.keep_within(math.inf)
    np.testing.assert_array_equal(reference.speed(place), before)


def test_the_profile_within_a_ramp_is_that_of_limited_accelerations():
    ramp, bends = 0.4, {"max_lateral_accel": 0.1}
    limited = profile_of(EIGHT, **bends, max_linear_accel=ramp, max_linear_decel=ramp)
    slow, hurried = (profile_of(EIGHT, **bends).within(ramp, hurries) for hurries in (False, True))
    places = np.linspace(0.0, 2.0 * EIGHT.length, 999)
    np.testing.assert_array_equal(slow.speed(places), limited.speed(places))
    fast = profile_of(
        EIGHT, **bends, max_linear_accel=ramp, max_linear_decel=ramp, desired_speed=0.65
    )
    np.testing.assert_array_equal(hurried.speed(places), fast.speed(places))


def test_time_lost_in_a_corner_is_made_good_in_part_before_it_and_in_part_after():
    path = path_through(np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]]), False)
    tuning = build(Settings, {})
    reference, ideal = (SpeedReference(SpeedProfile(path, tuning), tuning) for _ in range(2))
    reference.keep_within(0.8 / 0.7)
    dt, mine, other = 0.005, 0.0, 0.0
    ways = []
    while mine < 7.5:
        reference.spend(np.asarray(mine), dt)
        mine += dt * float(reference.speed(np.asarray(mine)))
        other += dt * float(ideal.speed(np.asarray(other)))
        ways.append((mine, other - mine))
    place, behind = np.array(ways).T
    assert np.abs(behind[place < 2.5]).max() < 1e-3
    assert -0.08 < behind.min() < -0.03
    assert 0.03 < behind.max() < 0.08
    assert np.argmin(behind) < np.argmax(behind)
    assert abs(np.interp(4.0, place, behind)) < 0.02
    assert abs(behind[-1]) < 0.01
