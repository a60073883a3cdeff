"""Paths against the analytic figure eight, circles, lines and finite differences."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.spatial import cKDTree

from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import circle, lissajous, named_path

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


def eight_position(p):
    return np.stack([10.0 * np.sin(p), 15.0 * np.sin(2.0 * p)], axis=-1)


def eight_velocity(p):
    return np.stack([10.0 * np.cos(p), 30.0 * np.cos(2.0 * p)], axis=-1)


def eight_curvature(p):
    dx, dy = 10.0 * np.cos(p), 30.0 * np.cos(2.0 * p)
    ddx, ddy = -10.0 * np.sin(p), -60.0 * np.sin(2.0 * p)
    return (dx * ddy - dy * ddx) / np.hypot(dx, dy) ** 3


@pytest.fixture(scope="module")
def lap():
    """Return parameters p of the analytic figure eight and their arc lengths by quadrature."""
    p = np.linspace(0.0, 2.0 * math.pi, 4001)
    half = 0.5 * np.diff(p)[:, None]
    nodes = p[:-1, None] + half * (1.0 + _NODES)
    speeds = np.linalg.norm(eight_velocity(nodes), axis=-1)
    lengths = (half * speeds) @ _WEIGHTS
    return p, np.concatenate([[0.0], np.cumsum(lengths)])


def wave(t):
    """Return a smooth open curve with bends to both sides."""
    return np.stack([t, np.sin(t) + 0.3 * np.cos(2.3 * t)], axis=-1)


PATHS = {
    "figure eight": lissajous(),
    "circle to the left": circle(0.5),
    "circle to the right": circle(-1.25),
    "line": named_path("line"),
    "open wave": Path.from_points(wave(np.linspace(0.0, 12.0, 400))),
    "closed points": Path.from_points(eight_position(np.linspace(0.0, 2.0 * math.pi, 2500))),
    "polyline of two points": Path.from_points([[1.0, 2.0], [4.0, -2.0]]),
    "three points": Path.from_points([[0.0, 0.0], [1.0, 0.2], [2.0, 0.0]]),
}
every_path = st.sampled_from(sorted(PATHS))


# --- the figure eight ---------------------------------------------------------------------------


def test_length_of_the_figure_eight(figure_eight, lap):
    assert figure_eight.closed
    assert abs(figure_eight.length - 130.975395) < 1e-4
    assert abs(figure_eight.length - lap[1][-1]) < 1e-6


def test_pose_of_the_figure_eight_by_arc_length(figure_eight, lap):
    p, arc_length = lap
    pose = figure_eight.frame(arc_length[:-1]).pose
    np.testing.assert_allclose(pose[:, :2], eight_position(p[:-1]), atol=1e-6)
    velocity = eight_velocity(p[:-1])
    tangent = velocity / np.linalg.norm(velocity, axis=-1, keepdims=True)
    direction = np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=-1)
    np.testing.assert_allclose(direction, tangent, atol=1e-6)


def test_curvature_of_the_figure_eight(figure_eight, lap):
    p, arc_length = lap
    expected = eight_curvature(p)
    found = figure_eight.curvature(arc_length)
    largest = np.abs(expected).max()
    assert abs(largest - 1.2251) < 1e-4
    assert abs(np.abs(found).max() / largest - 1.0) < 1e-4
    assert np.abs(found - expected).max() < 1e-4 * largest
    bent = np.abs(expected) > 0.01
    assert bent.sum() > 2000
    assert np.abs(found[bent] / expected[bent] - 1.0).max() < 1e-4


def test_distance_travelled_along_the_figure_eight_is_arc_length(figure_eight):
    arc_length = np.linspace(0.0, figure_eight.length, 40_001)
    places = figure_eight.frame(arc_length).pose[:, :2]
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    # Chords are shorter than arcs by kappa^2 ds^3 / 24: 5e-6 m over the lap at ds = 3 mm.
    np.testing.assert_allclose(travelled, arc_length, atol=3e-5)


def test_figure_eight_through_sampled_points(lap):
    p, arc_length = lap
    samples = np.interp(np.arange(0.0, arc_length[-1], 0.05), arc_length, p)
    path = Path.from_points(eight_position(samples), closed=True)
    assert abs(path.length - arc_length[-1]) < 1e-4
    error = path.curvature(arc_length) - eight_curvature(p)
    assert np.abs(error).max() < 5e-3
    np.testing.assert_allclose(path.frame(arc_length).pose[:, :2], eight_position(p), atol=1e-4)


# --- every path ---------------------------------------------------------------------------------


@settings(max_examples=150)
@given(name=every_path, place=st.floats(-0.3, 1.3))
def test_arc_length_heading_and_curvature_fit_each_other(name, place):
    path = PATHS[name]
    s, h = place * path.length, 1e-4
    ends = np.array([0.0, path.length])
    if not path.closed and np.abs(s - ends).min() < 2.0 * h:
        s += 4.0 * h  # curvature jumps to zero there
    behind, here, ahead = path.frame(np.array([s - h, s, s + h])).pose
    motion = (ahead[:2] - behind[:2]) / (2.0 * h)
    assert abs(np.linalg.norm(motion) - 1.0) < 1e-5
    np.testing.assert_allclose(motion, [np.cos(here[2]), np.sin(here[2])], atol=1e-5)
    turn = math.remainder(ahead[2] - behind[2], math.tau) / (2.0 * h)
    assert abs(turn - float(path.curvature(s))) < 1e-4


@settings(max_examples=60)
@given(name=every_path, places=npst.arrays(float, (2, 3), elements=st.floats(-1.0, 2.0)))
def test_frames_of_many_arc_lengths_are_those_of_each(name, places):
    path = PATHS[name]
    frames = path.frame(places * path.length)
    assert frames.pose.shape == (2, 3, 3)
    assert frames.curvature.shape == (2, 3)
    for index in np.ndindex(2, 3):
        single = path.frame(places[index] * path.length)
        np.testing.assert_allclose(frames.pose[index], single.pose, rtol=0.0, atol=1e-12)
        assert abs(frames.curvature[index] - single.curvature) < 1e-12


@pytest.mark.parametrize("name", sorted(PATHS))
def test_a_single_place_is_that_of_many_also_where_there_is_none(name):
    path = PATHS[name]
    places = np.random.default_rng(0).uniform(-0.5, 1.5, 500) * path.length
    places = np.append(places, [0.0, -0.0, path.length, 1e300, -math.inf, math.inf, math.nan])
    with np.errstate(invalid="ignore"):
        frames = path.frame(places)
        for place, pose, curvature in zip(places, frames.pose, frames.curvature, strict=True):
            single = path.frame(place)
            np.testing.assert_array_equal(single.pose, pose)
            # numpy's power of many numbers is another one in the last bit.
            np.testing.assert_allclose(single.curvature, curvature, rtol=1e-15)


@settings(max_examples=60)
@given(
    name=st.sampled_from([name for name in sorted(PATHS) if PATHS[name].closed]),
    place=st.floats(0.0, 1.0),
    laps=st.integers(-1000, 1000),
)
@example(name="figure eight", place=0.0, laps=1)
@example(name="figure eight", place=1.0, laps=-1)
def test_a_closed_path_goes_on_over_its_laps(name, place, laps):
    path = PATHS[name]
    s = place * path.length
    here, later = path.frame(s), path.frame(s + laps * path.length)
    np.testing.assert_allclose(later.pose[:2], here.pose[:2], atol=1e-8)
    assert abs(math.remainder(later.pose[2] - here.pose[2], math.tau)) < 1e-8
    assert abs(later.curvature - here.curvature) < 1e-7


@settings(max_examples=60)
@given(
    name=st.sampled_from([name for name in sorted(PATHS) if not PATHS[name].closed]),
    beyond=st.floats(1e-9, 1e4),
    at_the_end=st.booleans(),
)
def test_an_open_path_goes_on_straight_beyond_its_ends(name, beyond, at_the_end):
    path = PATHS[name]
    end = path.frame(path.length if at_the_end else 0.0).pose
    signed = beyond if at_the_end else -beyond
    frame = path.frame(path.length + beyond if at_the_end else -beyond)
    expected = [end[0] + signed * np.cos(end[2]), end[1] + signed * np.sin(end[2]), end[2]]
    np.testing.assert_allclose(frame.pose, expected, rtol=1e-12, atol=1e-9)
    assert frame.curvature == 0.0


@settings(max_examples=60)
@given(
    kappa=st.one_of(st.floats(0.05, 2.0), st.floats(-2.0, -0.05)),
    s=st.floats(-100.0, 100.0),
)
def test_a_circle_has_the_curvature_of_its_name(kappa, s):
    path = named_path(f"circle:{kappa!r}")
    assert path.closed
    assert math.isclose(path.length, 2.0 * math.pi / abs(kappa), rel_tol=1e-9)
    frame = path.frame(s)
    assert abs(frame.curvature / kappa - 1.0) < 1e-6
    expected = [math.sin(kappa * s) / kappa, (1.0 - math.cos(kappa * s)) / kappa]
    np.testing.assert_allclose(frame.pose[:2], expected, atol=1e-7)
    assert abs(math.remainder(frame.pose[2] - kappa * s, math.tau)) < 1e-6


@pytest.mark.parametrize("kappa", [1e4, -300.0, 50.0, -12.0, 0.01])
def test_curvature_of_tiny_and_large_circles(kappa):
    path = circle(kappa)
    s = np.linspace(0.0, path.length, 999)
    np.testing.assert_allclose(path.curvature(s) / kappa, 1.0, atol=1e-3)


@settings(max_examples=30)
@given(s=st.floats(-1e3, 1e3))
def test_the_line_is_straight_along_x(s):
    frame = PATHS["line"].frame(s)
    np.testing.assert_allclose(frame.pose, [s, 0.0, 0.0], atol=1e-9)
    assert abs(frame.curvature) < 1e-9


# --- from points --------------------------------------------------------------------------------


def distances_to(path, points):
    """Return the distance of each point to the polyline of the path at 2 mm."""
    places = path.frame(np.linspace(0.0, path.length, math.ceil(path.length / 0.002))).pose[:, :2]
    nearest = cKDTree(places).query(points)[1]
    distances = []
    for first in (nearest - 1, nearest):
        first = np.clip(first, 0, len(places) - 2)
        start, chord = places[first], places[first + 1] - places[first]
        along = ((points - start) * chord).sum(axis=1) / (chord * chord).sum(axis=1)
        foot = start + np.clip(along, 0.0, 1.0)[:, None] * chord
        distances.append(np.linalg.norm(points - foot, axis=1))
    return np.minimum(*distances)


@settings(max_examples=30)
@given(
    amplitudes=npst.arrays(float, (3, 2), elements=st.floats(-0.5, 0.5)),
    spacing=st.floats(0.02, 0.2),
)
def test_a_path_passes_through_its_points(amplitudes, spacing):
    t = np.arange(0.0, 6.0, spacing)
    waves = np.sin(t[:, None] * np.array([0.5, 1.0, 1.5]))
    points = np.stack([t, np.zeros_like(t)], axis=-1) + waves @ (amplitudes * [0.5, 1.0])
    path = Path.from_points(points)
    assert not path.closed
    np.testing.assert_allclose(path.frame(0.0).pose[:2], points[0], atol=1e-9)
    np.testing.assert_allclose(path.frame(path.length).pose[:2], points[-1], atol=1e-9)
    assert distances_to(path, points).max() < 1e-4


@settings(max_examples=20)
@given(fine=st.floats(0.004, 0.02))
def test_a_path_passes_through_its_points_where_few_of_them_are_dense(fine):
    bend = np.arange(0.0, math.pi / 2.0, fine / 0.05)[1:]
    corner = np.stack([3.0 + 0.05 * np.sin(bend), 0.05 * (1.0 - np.cos(bend))], axis=-1)
    along = np.arange(0.0, 3.05, 0.1)
    before = np.stack([along, np.zeros_like(along)], axis=-1)
    after = np.stack([np.full_like(along, 3.05), 0.15 + along], axis=-1)
    points = np.concatenate([before, corner, after])
    assert distances_to(Path.from_points(points), points).max() < 2e-3


def test_neighbours_that_coincide_count_once():
    t = np.linspace(0.0, 5.0, 60)
    points = wave(t)
    doubled = np.repeat(points, 3, axis=0)
    assert Path.from_points(doubled).digest() == Path.from_points(points).digest()


def test_points_whose_ends_meet_make_a_closed_path():
    angles = np.linspace(0.0, 2.0 * math.pi, 200)
    points = 2.0 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    by_default, joined = Path.from_points(points), Path.from_points(points[:-1], closed=True)
    cut = Path.from_points(points, closed=False)
    assert by_default.closed
    assert joined.closed
    assert not cut.closed
    for path in (by_default, joined, cut):
        assert abs(path.length - 4.0 * math.pi) < 1e-6
        np.testing.assert_allclose(path.curvature(np.linspace(0.0, 12.0, 50)), 0.5, atol=1e-3)
    open_arc = Path.from_points(points[:-20])
    assert not open_arc.closed


def test_the_curvature_of_a_closed_path_is_continuous_where_it_closes():
    path = PATHS["closed points"]
    before, after = path.curvature(np.array([-1e-6, 1e-6]))
    assert abs(before - after) < 1e-5


def test_points_along_a_path():
    for path in PATHS.values():
        poses = path.points(0.1)
        steps = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
        assert steps.max() < 0.1 + 1e-9
        assert steps.sum() > 0.995 * path.length
        np.testing.assert_allclose(poses[0], path.frame(0.0).pose, atol=1e-12)
        if path.closed:
            assert poses[-1].tolist() == poses[0].tolist()
        else:
            np.testing.assert_allclose(poses[-1], path.frame(path.length).pose, atol=1e-9)


def test_frames_do_not_depend_on_where_in_memory_they_are(figure_eight):
    """For arctan2 of components, numpy 1.26 chooses between two routines by where they are."""
    places, held, random = np.linspace(0.0, 40.0, 200), [], np.random.default_rng(1)
    first = figure_eight.frame(places)
    for _ in range(3000):
        held.append(np.empty(random.integers(160, 202)))
        if len(held) > 60:
            del held[random.integers(60)]
        again = figure_eight.frame(places)
        assert (again.pose == first.pose).all()
        assert (again.curvature == first.curvature).all()


def test_digests_tell_paths_apart():
    angles = np.linspace(0.0, 5.0, 60)
    points = np.stack([np.sin(angles), np.cos(angles)], axis=-1)
    moved = points.copy()
    moved[30, 1] += 1e-6
    digests = [
        Path.from_points(points).digest(),
        Path.from_points(moved).digest(),
        Path.from_points(points[::-1]).digest(),
        Path.from_points(points, closed=True).digest(),
        *(path.digest() for path in PATHS.values()),
    ]
    assert len(set(digests)) == len(digests)
    assert Path.from_points(points.tolist()).digest() == digests[0]
    assert lissajous().digest() == PATHS["figure eight"].digest()
    pieces = np.zeros((8, 2, 2))
    same_pieces = [Path(pieces, 1.0, False), Path(pieces, 1.0, True), Path(pieces, 2.0, False)]
    assert len({path.digest() for path in same_pieces}) == 3
