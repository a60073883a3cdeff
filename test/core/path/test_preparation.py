"""Poses as they come, against the polyline that they make."""

import contextlib
import itertools
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.spatial import cKDTree

from adp_path_follower.core.errors import PathError
from adp_path_follower.core.path import preparation
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.path.smoothing import is_fair
from adp_path_follower.core.settings.groups import PathSettings

FORWARDS = PathSettings()
BOTH_WAYS = PathSettings(allow_reversing=True)
SQUARE = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [0.0, 3.0], [0.0, 0.0]])


def distances(places, polyline):
    """Return the distance of each place (N, 2) to a polyline (M, 2), by trying every piece."""
    nearest = np.full(len(places), np.inf)
    for start, stop in itertools.pairwise(polyline):
        chord = stop - start
        length = max(float(chord @ chord), 1e-300)
        share = np.clip(((places - start) @ chord) / length, 0.0, 1.0)
        nearest = np.minimum(nearest, np.hypot(*(places - start - share[:, None] * chord).T))
    return nearest


def nearest_on(path, points):
    """Return the distance of each point (N, 2) to the path, seen as a polyline at 4 mm."""
    places = path.frame(np.linspace(0.0, path.length, math.ceil(path.length / 0.004) + 2)).pose
    places = places[:, :2]
    nearest = cKDTree(places).query(points)[1]
    found = np.full(len(points), np.inf)
    for offset in (-1, 0):
        first = np.clip(nearest + offset, 0, len(places) - 2)
        for point, index in enumerate(first.tolist()):
            piece = places[index : index + 2]
            found[point] = min(found[point], distances(points[point : point + 1], piece)[0])
    return found


def sampled(corners, spacing):
    """Return points along a polyline, at a spacing."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    places = np.linspace(0.0, along[-1], round(along[-1] / spacing) + 1)
    return np.stack([np.interp(places, along, axis) for axis in corners.T], axis=1)


def assert_within(route, points, tolerance):
    """Check that points and polyline are within a tolerance of the route, and it of them."""
    polyline = np.vstack([points, points[:1]]) if route.closed else points
    to_route = np.full(len(points), np.inf)
    for segment in route.segments:
        path = segment.path
        places = path.frame(np.linspace(0.0, path.length, 700)).pose[:, :2]
        assert distances(places, polyline).max() <= tolerance
        to_route = np.minimum(to_route, nearest_on(path, points))
    assert to_route.max() <= tolerance


def assert_smooth(path):
    """Check that curvature has no jumps: between two near places it changes by little."""
    s = np.linspace(0.0, path.length, 20_001)
    curvature = path.curvature(s)
    assert np.abs(np.diff(curvature)).max() < 0.15 * max(1.0, np.abs(curvature).max())


# --- what is smooth stays -----------------------------------------------------------------------


@pytest.mark.parametrize("spacing", [0.02, 0.05, 0.2])
def test_a_clean_figure_eight_is_driven_as_it_is(spacing):
    points = lissajous().points(spacing)[:, :2]
    route = prepare(points, FORWARDS)
    assert route.digest() == Path.from_points(points).digest()


@pytest.mark.parametrize("radius", [0.3, 1.0])
def test_twelve_points_of_a_circle_are_a_circle(radius):
    angles = np.linspace(0.0, math.tau, 13)
    route = prepare(radius * np.stack([np.cos(angles), np.sin(angles)], axis=1), FORWARDS)
    (segment,) = route.segments
    assert route.closed
    curvature = segment.path.curvature(np.linspace(0.0, segment.path.length, 500))
    np.testing.assert_allclose(curvature, 1.0 / radius, rtol=0.05)


def test_without_tolerance_the_path_goes_through_every_point():
    rng = np.random.default_rng(0)
    points = lissajous().points(0.2)[:200, :2] + rng.normal(0.0, 0.005, (200, 2))
    route = prepare(points, PathSettings(path_tolerance=0.0))
    assert route.digest() == Path.from_points(points).digest()


# --- corners and noise --------------------------------------------------------------------------


@pytest.mark.parametrize("spacing", [3.0, 0.5, 0.1, 0.05, 0.01])
@pytest.mark.parametrize("tolerance", [0.02, 0.05, 0.2])
def test_a_square_has_straight_sides_and_rounded_corners(spacing, tolerance):
    points = sampled(SQUARE, spacing)
    route = prepare(points, PathSettings(path_tolerance=tolerance))
    (segment,) = route.segments
    path = segment.path
    assert route.closed
    assert_within(route, points, tolerance)
    assert_smooth(path)
    s = np.linspace(0.0, path.length, 8001)
    places, curvature = path.frame(s).pose[:, :2], path.curvature(s)
    straight = (np.abs(places - 1.5) < 1.5 - 5.0 * tolerance).any(axis=1)
    assert straight.mean() > 0.3
    assert distances(places[straight], SQUARE).max() < 0.05 * tolerance
    # A circle that rounds the corner within the tolerance bends by this much, all at once; where
    # the curvature has to grow, the most must be more.
    least = (math.sqrt(2.0) - 1.0) / tolerance
    assert np.abs(curvature[straight]).max() < 0.03 * least
    assert np.abs(curvature).max() < 2.2 * least
    assert curvature.min() > -0.03 * least


@pytest.mark.parametrize("spacing", [0.02, 0.1])
@pytest.mark.parametrize("begins", [0.0, 0.5, 1.0])
def test_a_smooth_curve_is_driven_as_given_however_it_bends_at_its_ends(spacing, begins):
    x = np.arange(begins, 12.0 + begins, spacing)
    slalom = np.column_stack([x, 0.5 * np.cos(0.5 * math.pi * x)])
    angle = np.arange(begins, 2.0 + begins, spacing / 0.8)
    arc = 0.8 * np.column_stack([np.cos(angle), np.sin(angle)])
    for points in (slalom, arc):
        (segment,) = prepare(points, FORWARDS).segments
        assert nearest_on(segment.path, points).max() < 1e-4


@pytest.mark.parametrize("noise", [0.001, 0.005, 0.01])
def test_noise_is_averaged(noise):
    rng = np.random.default_rng(3)
    clean = lissajous().points(0.05)[:1200, :2]
    points = clean + rng.normal(0.0, noise, clean.shape)
    route = prepare(points, FORWARDS)
    assert_within(route, points, 0.05)
    (segment,) = route.segments
    curvature = segment.path.curvature(np.linspace(0.0, segment.path.length, 5000))
    assert np.abs(curvature).max() < 1.2251 * 1.3
    rough = Path.from_points(points, closed=False) if noise < 0.005 else None
    if rough is not None:
        assert np.abs(rough.curvature(np.linspace(0.0, rough.length, 5000))).max() > 2.0


def test_laps_in_one_message_and_crossings_stay_apart():
    lap = lissajous().points(0.05)[:, :2]
    points = np.vstack([lap, lap[1:], lap[1:]])
    route = prepare(points, FORWARDS)
    assert route.closed
    assert route.length == pytest.approx(3.0 * 130.975395, abs=1e-3)


# --- directions ---------------------------------------------------------------------------------


def described(route):
    return [(segment.reverse, round(segment.path.length, 1)) for segment in route.segments]


THERE_AND_BACK = sampled(np.array([[0.0, 0.0], [2.0, 0.0], [0.5, 0.8]]), 0.05)


def test_a_cusp_is_refused_with_its_place_or_driven_backwards():
    with pytest.raises(PathError, match=r"turns back at pose 40 at \(2\.00, 0\.00\)"):
        prepare(THERE_AND_BACK, FORWARDS)
    route = prepare(THERE_AND_BACK, BOTH_WAYS)
    assert described(route) == [(False, 2.0), (True, 1.7)]
    np.testing.assert_allclose(route.segments[1].path.frame(0.0).pose[:2], [2.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_noise_makes_no_cusps_and_hides_none(noise):
    rng = np.random.default_rng(1)
    points = sampled(np.array([[0.0, 0.0], [2.0, 0.0], [0.5, 0.8]]), 0.01)
    noisy = points + rng.normal(0.0, noise, points.shape)
    assert [reverse for reverse, _ in described(prepare(noisy, BOTH_WAYS))] == [False, True]


def test_orientations_decide_what_is_driven_backwards():
    chords = np.diff(THERE_AND_BACK, axis=0)
    motion = np.arctan2(chords[:, 1], chords[:, 0])
    headings = np.append(motion, motion[-1])
    as_a_car = np.where(np.arange(len(headings)) <= 40, headings, headings + math.pi)
    assert [reverse for reverse, _ in described(prepare(THERE_AND_BACK, BOTH_WAYS, as_a_car))] == [
        False,
        True,
    ]
    first_backwards = as_a_car + math.pi
    route = prepare(THERE_AND_BACK, BOTH_WAYS, first_backwards)
    assert [reverse for reverse, _ in described(route)] == [True, False]


def test_a_straight_path_with_its_orientations_against_it_is_backed_along():
    points = sampled(np.array([[1.0, 1.0], [3.0, 2.0]]), 0.1)
    heading = math.atan2(1.0, 2.0)
    backwards = np.full(len(points), heading + math.pi)
    assert described(prepare(points, BOTH_WAYS, backwards)) == [(True, 2.2)]
    with pytest.raises(PathError, match=r"driven backwards from pose 0 at \(1\.00, 1\.00\)"):
        prepare(points, FORWARDS, backwards)
    halfway = np.where(np.arange(len(points)) < 11, heading, heading + math.pi)
    assert [reverse for reverse, _ in described(prepare(points, BOTH_WAYS, halfway))] == [
        False,
        True,
    ]


@pytest.mark.parametrize(
    "headings",
    [
        np.zeros(20),
        np.append(np.zeros(19), 2.5),  # planners that orient the goal only
        np.full(20, np.nan),
        np.append(np.full(19, math.pi), 0.0),
        np.full(20, 1.5),
    ],
)
def test_orientations_that_say_nothing_of_the_direction_are_passed_over(headings):
    points = sampled(np.array([[0.0, 0.0], [-2.0, 0.0]]), 2.0 / 19.0)
    assert described(prepare(points, BOTH_WAYS, headings)) == [(False, 2.0)]


def test_a_path_is_closed_where_that_is_said():
    assert not prepare(SQUARE[:4], FORWARDS).closed
    assert prepare(SQUARE[:4], PathSettings(path_closed="closed")).closed
    assert not prepare(SQUARE, PathSettings(path_closed="open")).closed
    assert prepare(SQUARE[:4], FORWARDS, closed=True).closed
    with pytest.raises(PathError, match="said to be closed, but turns back at pose 40"):
        prepare(THERE_AND_BACK, PathSettings(path_closed="closed", allow_reversing=True))


# --- whatever comes -----------------------------------------------------------------------------


coordinates = st.one_of(
    st.integers(-400, 400).map(lambda n: n / 100.0),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e9, -1e300, 1e-7, 5e-324, -0.0]),
)
finite = st.integers(-150, 150).map(lambda n: n / 100.0)
angles = st.one_of(st.floats(-4.0, 4.0), st.sampled_from([math.nan, math.inf, 1e300, 0.0]))
many = st.integers(2, 8)
settings_of_paths = st.builds(
    PathSettings,
    path_tolerance=st.sampled_from([0.03, 0.05, 0.3]),
    allow_reversing=st.booleans(),
    path_closed=st.sampled_from(["auto", "open", "closed"]),
)


def route_or_refusal(points, path_settings, headings):
    """Return the route, None after a refusal in one sentence; nothing else may happen."""
    try:
        route = prepare(points, path_settings, headings)
    except PathError as error:
        refusal = str(error)
    else:
        refusal = ""
    if refusal:
        assert "\n" not in refusal
        assert len(refusal) < 250
        return None
    for segment in route.segments:
        assert 0.0 < segment.path.length < math.inf
        frame = segment.path.frame(np.linspace(-1.0, segment.path.length + 1.0, 300))
        assert np.isfinite(frame.pose).all()
        assert np.isfinite(frame.curvature).all()
        assert path_settings.allow_reversing or not segment.reverse
    assert path_settings.allow_reversing or len(route.segments) == 1
    return route


@settings(max_examples=100)
@given(
    rows=npst.arrays(float, st.tuples(many, st.just(2)), elements=coordinates),
    headings=npst.arrays(float, many, elements=angles),
    path_settings=settings_of_paths,
)
def test_any_numbers_give_a_route_or_a_sentence(rows, headings, path_settings):
    route_or_refusal(rows, path_settings, headings)


@settings(max_examples=60)
@given(
    points=npst.arrays(float, st.tuples(many, st.just(2)), elements=finite),
    noise=st.sampled_from([0.0, 0.0, 0.003]),
    spacing=st.sampled_from([None, 0.2, 0.05]),
    path_settings=settings_of_paths,
    with_headings=st.booleans(),
)
@example(  # a tip at a cusp
    points=np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.1]]),
    noise=0.0,
    spacing=0.03,
    path_settings=BOTH_WAYS,
    with_headings=False,
)
def test_any_polyline_is_followed_within_the_tolerance(
    points, noise, spacing, path_settings, with_headings
):
    moving = np.append(True, np.hypot(*np.diff(points, axis=0).T) > 1e-3)
    points = points[moving]
    if spacing is not None and len(points) > 1:
        points = sampled(points, spacing)
    points = points + np.random.default_rng(0).normal(0.0, noise, points.shape)
    headings = np.linspace(-3.0, 3.0, len(points)) if with_headings else None
    route = route_or_refusal(points, path_settings, headings)
    if route is not None:
        assert_within(route, points, path_settings.path_tolerance + 1e-9)


@pytest.mark.parametrize("closed", [None, True, False])
def test_a_long_path_is_tried_for_fairness_once(monkeypatch, closed):
    asked = []

    def spied(*arguments):
        asked.append(arguments)
        return is_fair(*arguments)

    monkeypatch.setattr(preparation, "is_fair", spied)
    prepare(SQUARE, FORWARDS, closed=closed)
    assert len(asked) == 1


def test_rounded_coordinates_of_dense_points_bend_no_curve():
    turns = np.linspace(0.0, 2.0 * np.pi, 100_001)
    points = np.column_stack([60.0 * np.cos(turns), 30.0 * np.sin(turns)]).round(6)
    route = prepare(points, PathSettings())
    assert route.closed
    curvature = route.segments[0].path.curvature(np.linspace(0.0, route.length, 20_000)[:-1])
    exact = 30.0 / 60.0**2, 60.0 / 30.0**2
    assert exact[0] - 0.02 < curvature.min()
    assert curvature.max() < exact[1] + 0.02


def test_dense_points_of_a_corner_are_no_farther_than_the_tolerance():
    side = np.linspace(0.0, 2.0, 2001)
    points = np.vstack(
        [np.column_stack([side, 0.0 * side]), np.column_stack([2.0 + 0.0 * side, side])]
    )
    path = prepare(points, PathSettings()).segments[0].path
    assert cKDTree(path.points(0.001)[:, :2]).query(points)[0].max() < 0.05


@pytest.mark.parametrize("spacing", [0.02, 0.1])
@pytest.mark.parametrize(("decimals", "bend"), [(6, 0.002), (4, 0.01), (3, 0.03), (2, 0.06)])
def test_rounded_coordinates_bend_no_path(spacing, decimals, bend):
    """A slalom y = sin(0.9 x); in millimetres it was bent by up to 0.33 1/m."""
    x = np.linspace(0.0, 20.0, 200_001)
    along = np.cumsum(np.hypot(1.0, 0.9 * np.cos(0.9 * x))) * 1e-4
    x = np.interp(np.arange(0.0, along[-1], spacing), along, x)
    points = np.round(np.column_stack([x, np.sin(0.9 * x)]), decimals)
    path = prepare(points, FORWARDS).segments[0].path
    frame = path.frame(np.linspace(0.5, path.length - 0.5, 3000))
    place = 0.9 * frame.pose[:, 0]
    true = -0.81 * np.sin(place) / (1.0 + (0.9 * np.cos(place)) ** 2) ** 1.5
    assert np.abs(frame.curvature - true).max() < bend
    assert nearest_on(path, points).max() < 1.2 * 10.0**-decimals + 2e-6


@pytest.mark.parametrize("seed", range(4))
def test_rounded_points_at_any_distance_make_a_path(seed):
    """Points along a line at random distances, a retraced line, and a loop of 4 mm."""
    random = np.random.default_rng(seed)
    uneven = np.sort(random.uniform(0.0, 0.05, 137))
    there = np.linspace(0.0, 1.0, 97)
    angle = np.linspace(0.0, math.tau, 29)
    for points, chosen in [
        (np.column_stack([np.zeros(137), uneven]), FORWARDS),
        (np.column_stack([np.append(there, there[::-1]), np.zeros(194)]), BOTH_WAYS),
        (0.002 * np.column_stack([np.sin(angle), np.cos(angle)]), FORWARDS),
    ]:
        for decimals in (2, 3, 4, 5, 6):
            with contextlib.suppress(PathError):  # too few are left
                assert np.isfinite(prepare(np.round(points, decimals), chosen).length)
