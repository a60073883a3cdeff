"""The nearest place on a path: on the whole of it, and near the last one."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import circle, lissajous, named_path
from adp_path_follower.core.path.nearest import beside, best_place, place_near

EIGHT, WAVE = lissajous(), np.linspace(0.0, 12.0, 400)
PATHS = {
    "figure eight": EIGHT,
    "circle to the left": circle(0.5),
    "circle to the right": circle(-1.25),
    "line": named_path("line"),
    "open wave": Path.from_points(np.stack([WAVE, np.sin(WAVE) + 0.3 * np.cos(2.3 * WAVE)], -1)),
    "closed points": Path.from_points(EIGHT.points(0.05)[:, :2]),
    "polyline of two points": Path.from_points([[1.0, 2.0], [4.0, -2.0]]),
    "three points": Path.from_points([[0.0, 0.0], [1.0, 0.2], [2.0, 0.0]]),
}
every_path = st.sampled_from(sorted(PATHS))


def gap_along(path, first, second):
    """Return the distance between two arc lengths, around a closed path."""
    difference = first - second
    return abs(math.remainder(difference, path.length) if path.closed else difference)


@settings(max_examples=60)
@given(name=every_path, place=st.floats(0.0, 1.0))
def test_the_nearest_place_to_a_pose_on_the_path_is_there(name, place):
    path = PATHS[name]
    pose = path.frame(place * path.length).pose
    assert gap_along(path, best_place(path, pose)[0], place * path.length) < 0.0101


@settings(max_examples=60)
@given(place=st.floats(0.0, 1.0), offset=st.floats(-0.2, 0.2), turn=st.floats(-0.2, 0.2))
def test_the_nearest_place_to_a_pose_beside_the_figure_eight(figure_eight, place, offset, turn):
    s = place * figure_eight.length
    x, y, heading = figure_eight.frame(s).pose
    pose = np.array(
        [x - offset * math.sin(heading), y + offset * math.cos(heading), heading + turn]
    )
    assert gap_along(figure_eight, best_place(figure_eight, pose)[0], s) < 0.35


def test_at_the_crossing_of_the_figure_eight_the_heading_decides(figure_eight):
    upwards, leftwards = math.atan2(30.0, 10.0), math.atan2(30.0, -10.0)
    for heading, place in ((upwards, 0.0), (leftwards, 0.5 * figure_eight.length)):
        found, _ = best_place(figure_eight, np.array([0.0, 0.0, heading]))
        assert gap_along(figure_eight, found, place) < 0.02


@pytest.fixture(scope="module")
def robots(figure_eight):
    """Return places on the figure eight and robots up to 0.4 m beside them."""
    random = np.random.default_rng(3)
    places = random.uniform(0.0, figure_eight.length, 40)
    x, y, heading = figure_eight.frame(places).pose.T
    offset, turn = random.uniform(-0.4, 0.4, (2, 40))
    poses = [x - offset * np.sin(heading), y + offset * np.cos(heading), heading + turn]
    return places, offset, turn, np.stack(poses, axis=-1)


def test_a_batch_has_the_places_of_its_robots(figure_eight, robots):
    places, _, _, poses = robots
    together = best_place(figure_eight, poses.reshape(8, 5, 3))
    near = place_near(figure_eight, poses.reshape(8, 5, 3), places.reshape(8, 5) + 0.3)
    for robot, pose in enumerate(poses):
        alone, score = best_place(figure_eight, pose)
        row = np.unravel_index(robot, (8, 5))
        assert together[0][row] == alone
        assert together[1][row] == pytest.approx(score, abs=1e-12)
        assert near[row] == pytest.approx(
            place_near(figure_eight, pose, places[robot] + 0.3), abs=1e-9
        )


def test_the_exact_place_is_the_foot_of_the_perpendicular(figure_eight, robots):
    places, offset, turn, poses = robots
    near = place_near(figure_eight, poses, places - 0.4)
    assert near == pytest.approx(places, abs=1e-9)
    found = beside(figure_eight, poses, places + 0.2, 0.5)
    assert found.arc_length == pytest.approx(places, abs=1e-9)
    assert found.cross_track == pytest.approx(offset, abs=1e-9)
    assert found.heading == pytest.approx(turn, abs=1e-9)


@pytest.mark.parametrize("name", ["figure eight", "closed points", "line"])
def test_the_place_near_the_last_is_the_least_distance_within_reach(name):
    path = PATHS[name]
    random = np.random.default_rng(5)
    for last in random.uniform(1.0, path.length - 1.0, 20):
        x, y, heading = path.frame(last).pose
        pose = np.array([x, y, heading]) + random.uniform(-0.3, 0.3, 3)

        def distance(place, pose=pose):
            return math.hypot(*(path.frame(place).pose[:2] - pose[:2]))

        bounds = (last - 1.0, last + 1.0)
        least = minimize_scalar(distance, bounds=bounds, method="bounded")
        found = place_near(path, pose, last)
        assert distance(found) <= least.fun + 1e-9
