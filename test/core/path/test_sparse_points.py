"""Sparse points of a smooth curve are driven as the curve, and corners as corners."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.path.library import path_from_file, read_poses
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.settings.groups import PathSettings

# Length [m], curvature at its ends [1/m]: a track of bends that grow and shrink steadily.
TRACK = [
    *[(60, 0.0, 0.0), (10, 0.0, 0.165), (14, 0.165, 0.165), (10, 0.165, 0.0), (30, 0.0, 0.0)],
    *[(15, 0.0, -0.08), (20, -0.08, -0.08), (15, -0.08, 0.0), (40, 0.0, 0.0)],
]
STEP = 0.01  # [m]


def track():
    """Return points 1 cm apart along the track, (N, 2), by summing up its curvature."""
    bends = [np.linspace(first, last, round(length / STEP)) for length, first, last in TRACK]
    heading = np.cumsum(np.concatenate(bends)) * STEP
    return np.cumsum(np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0) * STEP


def bend_of(route):
    (segment,) = route.segments
    return float(np.abs(segment.path.curvature(np.linspace(0, route.length, 5000))).max())


@settings(max_examples=8)
@given(first=st.integers(0, 499), noise=st.sampled_from([0.0, 0.01]), turn=st.floats(-3.0, 3.0))
def test_a_track_5_m_apart_bends_no_more_than_the_track(first, noise, turn):
    true = track() @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    points = true[first::500]
    points = points + noise * np.random.default_rng(first).standard_normal(points.shape)
    route = prepare(points, PathSettings())
    assert bend_of(route) < 1.25 * 0.165
    places = route.segments[0].path.points(0.5)[5:-5, :2]
    gap = np.hypot(*(true[None, ::10] - places[:, None]).transpose(2, 0, 1)).min(axis=1)
    assert gap.max() < 0.25  # chords are up to 0.5 m off


@pytest.mark.parametrize("count", [8, 12, 24])
def test_points_of_a_circle_are_a_circle_of_any_size(count):
    angles = np.linspace(0.0, math.tau, count + 1)
    route = prepare(20.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1), PathSettings())
    assert bend_of(route) < 1.1 / 20.0


@pytest.mark.parametrize(
    "corners",
    [
        [(0, 0), (4, 0), (4, 3), (1, 3), (1, 6), (5, 6)],
        [(0, 0), (6, 0), (6, 0.5), (0, 0.5), (0, 1.0), (6, 1.0)],  # lanes
        [(0, 0), (3, 0), (3, 3), (0, 3), (0, 0)],
        [(0, 0), (5, 0), (6, 1), (6, 6), (12, 6)],  # a corner cut off
        [(0, 0), (5, 2), (10, 0), (15, 2), (20, 0)],  # from side to side
    ],
)
@pytest.mark.parametrize("spacing", [None, 0.5, 0.1])
def test_corners_between_straight_pieces_stay_corners(corners, spacing):
    points = np.array(corners, float)
    lines = points
    if spacing is not None:
        parts = [
            np.linspace(a, b, math.ceil(math.dist(a, b) / spacing), endpoint=False)
            for a, b in itertools.pairwise(points)
        ]
        points = np.vstack([*parts, points[-1:]])
    route = prepare(points, PathSettings())
    places = route.segments[0].path.points(0.02)[:, :2]
    gaps = []
    for a, b in itertools.pairwise(lines):
        share = np.clip((places - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        gaps.append(np.hypot(*(a + share[:, None] * (b - a) - places).T))
    assert np.min(gaps, axis=0).max() < 0.05 + 1e-3  # the tolerance, as promised


def test_the_route_says_by_how_much_its_poses_bend():
    sharp = prepare([(0, 0), (4, 0), (4, 3)], PathSettings())
    assert sharp.bend_of_poses == pytest.approx(0.5 * math.pi / 3.5)
    assert sharp.bend > 3.0 * sharp.bend_of_poses
    smooth = prepare(track()[::500], PathSettings())
    assert smooth.bend < 1.5 * smooth.bend_of_poses


@pytest.mark.parametrize(
    "text",
    [
        "# x_m,y_m,w_tr_right_m,w_tr_left_m\n0,0,1,1\n5,0,1,1\n# half way\n10,1,1,1\n",
        "# made by hand\n# s_m; x_m; y_m; psi_rad\n0;0;0;0\n5; 5;0;0\n10;10;1;0\n",
        "X [cm],note,Y [cm]\n0,a,0\n500,b,0\n1000,c,100\n",
        'x_mm;"y_mm"\n0;0\n5000;0\n10000;1000\n',
        "\n\n# by hand\n\nx,y\n0,0\n5,0\n\n10,1\n",
    ],
)
def test_csv_files_are_read_as_they_come(tmp_path, text):
    file = tmp_path / "track.csv"
    file.write_text(text)
    poses, _ = read_poses(file)
    np.testing.assert_allclose(poses[:, :2], [[0, 0], [5, 0], [10, 1]], atol=1e-12)
    assert np.isnan(poses[:, 2]).all()
    assert path_from_file(file).length > 10.0


def test_headings_are_read_in_radians(tmp_path):
    file = tmp_path / "poses.csv"
    file.write_text("x_m,y_m,yaw_deg\n0,0,0\n1,0,90\n")
    np.testing.assert_allclose(read_poses(file)[0], [[0, 0, 0], [1, 0, 0.5 * math.pi]])
