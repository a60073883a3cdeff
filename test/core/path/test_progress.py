"""Where following begins and goes on: on routes that one pose does not tell the place of."""

from __future__ import annotations

import math

import numpy as np
import pytest
from field_routes import OPEN, case, lanes, laps, loop, random_route
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import circle, lissajous
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.path.progress import Left, Place, first_place, new_start, next_place
from adp_path_follower.core.path.route import Route, Segment, route_of
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.schema import build

ROBOT = 0.3  # [m], the length of a small robot


def beside(route, place, along=0.0, across=0.0, turn=0.0):
    """Return the pose of a robot at an arc length of the first segment, or off it [m, rad]."""
    x, y, heading = route.segments[0].path.frame(place).pose
    cos, sin = math.cos(heading), math.sin(heading)
    return np.array(
        [x + along * cos - across * sin, y + along * sin + across * cos, heading + turn]
    )


def left_at(route, place, segment=0, done=False):
    """Return following that ended with the robot at its target."""
    return Left(route, Place(segment, place), beside(route, place), done)


# Routes


def routes():
    return st.integers(0, 23).map(random_route)


@settings(max_examples=60)
@given(
    route=routes(),
    behind=st.floats(0.0, 0.05),
    across=st.floats(-0.05, 0.05),
    turn=st.floats(-3.1, 3.1),
)
def test_a_robot_at_the_first_pose_begins_there_whatever_it_faces(route, behind, across, turn):
    place = first_place(route, beside(route, 0.0, -behind, across, turn))
    assert place.segment == 0
    assert place.arc_length <= ROBOT


@settings(max_examples=60)
@given(
    route=routes(),
    share=st.floats(0.0, 1.0),
    coasted=st.floats(-0.3, 0.6),
    across=st.floats(-0.03, 0.03),
    turn=st.floats(-1.0, 1.0),
)
def test_following_goes_on_where_it_was(route, share, coasted, across, turn):
    last = share * route.length
    true = min(max(last + coasted, 0.0), route.length)
    place = next_place(route, beside(route, true, 0.0, across, turn), left_at(route, last))
    assert place.segment == 0
    assert abs(place.arc_length - true) < ROBOT


@settings(max_examples=40)
@given(
    route=routes(),
    share=st.floats(0.25, 0.75),
    before=st.floats(0.0, 0.2),
    after=st.floats(0.8, 1.0),
    extended=st.booleans(),
)
def test_a_path_with_other_ends_is_gone_on_with(route, share, before, after, extended):
    """From the whole to a part, or from a part to the whole, at the place on the whole."""
    poses = route.segments[0].path.points(0.05)[:, :2]
    first, stop = int(before * len(poses)), math.ceil(after * len(poses))
    start = first / (len(poses) - 1) * route.length
    whole, part = prepare(poses, OPEN), prepare(poses[first:stop], OPEN)
    place = share * route.length
    assume(place - start < part.length)
    if extended:
        found = next_place(whole, beside(whole, place), left_at(part, place - start))
        assert abs(found.arc_length - place) < ROBOT
    else:
        found = next_place(part, beside(whole, place), left_at(whole, place))
        assert abs(found.arc_length - (place - start)) < ROBOT


@settings(max_examples=60)
@given(route=routes(), share=st.floats(0.0, 1.0), across=st.floats(-0.03, 0.03))
def test_a_new_route_begins_at_the_first_place_that_fits(route, share, across):
    pose = beside(route, share * route.length, 0.0, across)
    found = first_place(route, pose).arc_length
    path = route.segments[0].path
    assert math.dist(path.frame(found).pose[:2], pose[:2]) < 0.15
    earlier = np.arange(0.0, found - ROBOT, 0.01)
    frames = path.frame(earlier).pose
    fits = np.hypot(*(frames[:, :2] - pose[:2]).T) < 0.04
    assert not (fits & (np.cos(frames[:, 2] - pose[2]) > math.cos(0.3))).any()


@settings(max_examples=40)
@given(route=routes(), share=st.floats(0.0, 1.0), carried=st.floats(0.0, 1.0))
def test_a_robot_that_was_carried_is_searched_for_on_the_whole_path(route, share, carried):
    pose = beside(route, carried * route.length)
    assume(math.dist(beside(route, share * route.length)[:2], pose[:2]) > 1.01)
    found = next_place(route, pose, left_at(route, share * route.length))
    assert math.dist(route.segments[0].path.frame(found.arc_length).pose[:2], pose[:2]) < 0.15


# Inputs from the field


@pytest.mark.parametrize(
    ("name", "settings_of_paths", "behind", "turn", "length"),
    [
        ("loop_open.csv", OPEN, 0.02, 0.0, 4.0 * math.pi),
        ("loop_gap_3cm.csv", PathSettings(), 0.02, 0.0, 4.0 * math.pi - 0.03),
        ("three_laps_noisy.csv", PathSettings(), 0.01, 0.0, 9.2),
        ("lawnmower_lanes_0.5m.csv", PathSettings(), 0.0, math.radians(149.0), 22.0),
    ],
)
def test_the_whole_of_what_was_given_lies_ahead(name, settings_of_paths, behind, turn, length):
    route = case(name, settings_of_paths)
    assert route.length == pytest.approx(length, abs=0.05)
    assert first_place(route, beside(route, 0.0, -behind, 0.0, turn)) == Place(0, 0.0)


# Rules


def test_a_far_robot_begins_beside_the_line_and_one_before_it_at_its_start():
    line = route_of(Path.from_points([[0.0, 0.0], [40.0, 0.0]]))
    assert first_place(line, np.array([20.0, 5.0, 2.0])).arc_length == pytest.approx(20.0, abs=0.02)
    assert first_place(line, np.array([-5.0, 1.0, 0.0])) == Place(0, 0.0)


def test_the_heading_tells_lanes_and_crossings_apart_but_no_more():
    mower = prepare(lanes(4, 0.5, 6.0), OPEN)
    between = np.array([3.0, 0.26, math.pi])  # lane 2 is 2 cm nearer, and goes that way
    assert 6.5 < first_place(mower, between).arc_length < 10.0
    assert first_place(mower, between - [0.0, 0.0, math.pi]).arc_length == pytest.approx(
        3.0, abs=0.02
    )
    across = between - [0.0, 0.0, 0.5 * math.pi]
    assert first_place(mower, across).arc_length == pytest.approx(3.0, abs=0.02)
    eight = route_of(lissajous())
    here, there = (eight.segments[0].path.frame(share * eight.length).pose for share in (0.0, 0.5))
    assert first_place(eight, here).arc_length == pytest.approx(0.0, abs=0.02)
    assert first_place(eight, there).arc_length == pytest.approx(0.5 * eight.length, abs=0.02)


def test_the_start_is_chosen_by_the_settings():
    route, pose = case("lawnmower_lanes_0.5m.csv"), np.array([3.0, 0.5, math.pi])
    starts = {
        name: new_start(route, pose, build(Settings, {"path_start": name}).controller).arc_length
        for name in ("earliest", "beginning", "nearest")
    }
    assert starts["beginning"] == 0.0
    assert starts["earliest"] == pytest.approx(starts["nearest"], abs=0.03)
    chosen = {"path_start": "arc_length", "start_arc_length": 10.9}
    assert new_start(route, pose, build(Settings, chosen).controller) == Place(0, 10.9)
    there_and_back = Route((Segment(Path.from_points([[0, 0], [4, 0]])),) * 3)
    assert new_start(there_and_back, pose, build(Settings, chosen).controller).segment == 2
    beyond = build(Settings, chosen | {"start_arc_length": 23.0})
    with pytest.raises(SettingsError, match=r"is 23, but the path is 21.97 m long"):
        new_start(route, pose, beyond.controller)


def test_a_robot_pushed_into_the_next_lane_goes_on_in_its_own():
    mower = prepare(lanes(4, 0.5, 6.0), OPEN)
    pushed = np.array([3.0, 0.5, math.pi])
    assert next_place(mower, pushed, left_at(mower, 3.0)).arc_length == pytest.approx(3.0, abs=0.05)
    carried = np.array([3.0, 1.5, math.pi])  # to lane 4
    assert next_place(mower, carried, left_at(mower, 3.0)).arc_length > 20.0


def test_laps_of_a_closed_path_are_not_lost():
    route = route_of(circle(0.5))
    place = next_place(route, beside(route, 1.0), left_at(route, 2.0 * route.length + 0.9))
    assert place.arc_length == pytest.approx(2.0 * route.length + 1.0, abs=0.03)


def test_a_path_in_a_frame_that_has_drifted_is_the_same():
    points = laps(3.0, 0.5, 0.0, np.random.default_rng(0))
    before, after = prepare(points, OPEN), prepare(points + np.array([0.15, -0.1]), OPEN)
    assert next_place(after, beside(before, 7.0), left_at(before, 7.0)).arc_length == pytest.approx(
        7.0, abs=ROBOT
    )


def test_another_path_and_a_job_that_is_done_begin_anew():
    line = Path.from_points([[0.0, 0.0], [6.0, 0.0]])
    turned = route_of(Path.from_points([[3.0, 0.0], [3.0, 6.0]]))
    assert next_place(turned, np.array([3.0, 0.0, 0.0]), left_at(route_of(line), 3.0)) is None
    back = route_of(Path.from_points([[6.0, 0.0], [0.0, 0.0]]))
    assert next_place(back, np.array([6.0, 0.0, 0.0]), left_at(route_of(line), 6.0)) is None
    loop_again = prepare(loop(0.1, 2.0)[:-1], OPEN)  # the loop, but for its last pose
    done = left_at(prepare(loop(0.1, 2.0), OPEN), 12.4, done=True)
    assert next_place(loop_again, done.pose, done) is None
    longer = route_of(Path.from_points([[0.0, 0.0], [9.0, 0.0]]))
    done = left_at(route_of(line), 6.0, done=True)
    assert next_place(longer, done.pose, done).arc_length == pytest.approx(6.0, abs=0.03)


def test_a_robot_that_is_beyond_all_bounds_is_looked_for_all_the_same():
    for route in (route_of(circle(0.5)), route_of(Path.from_points([[0.0, 0.0], [40.0, 0.0]]))):
        far = np.array([1e8, -1e8, 0.0])
        assert next_place(route, far, left_at(route, 3.0)).segment == 0
