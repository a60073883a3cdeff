"""Points that make no path."""

import math
import re

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from adp_path_follower.core.errors import PathError
from adp_path_follower.core.path.curve import Path

_ZIGZAG = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [1.0, 0.0], [0.5, 0.0]]


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([[1.0, 2.0]], "1 distinct points.*at least 2"),
        ([[1.0, 2.0]] * 7, "1 distinct points.*at least 2"),
        ([[1.0, 2.0], [1.0, 2.0 + 1e-9]], "1 distinct points.*at least 2"),
        (np.zeros((0, 2)), "0 distinct points.*at least 2"),
        ([[0.0, 0.0], [1.0, math.nan]], "point 1 .*nan.*must be finite"),
        ([[0.0, 0.0], [1.0, 0.0], [-math.inf, 0.0]], "point 2 .*inf.*must be finite"),
        (np.zeros((1_000_001, 2)), "1000001 points.*at most 1000000"),
        ([[0.0, 0.0], [1e9, 0.0]], "above 1e8 m.*units"),
        ([0.0, 1.0, 2.0], r"shape \(3,\)"),
        ([[0.0, 1.0, 2.0], [1.0, 1.0, 2.0]], r"shape \(2, 3\)"),
        (np.zeros((3, 2, 2)), r"shape \(3, 2, 2\)"),
        (7.0, r"shape \(\)"),
        (_ZIGZAG, r"turns back on itself.*near \(1\.\d+, -?0\.00\)"),
        ([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]], "turns back on itself"),
        ([[0.0, 0.0], [1.0, 0.0], [0.5, 0.0]], "turns back on itself"),
        ([[0.0, 0.0], [1.0]], "path"),
        ([["here", "there"], ["a", "b"]], "path"),
        ([[0.0, 0.0], [10**400, 0.0]], "path"),
        ([[1j, 0.0], [1.0, 0.0]], "path"),
        (None, "path"),
    ],
)
def test_points_that_make_no_path_are_refused_in_a_sentence(points, words):
    with pytest.raises(PathError) as caught:
        Path.from_points(points)
    message = str(caught.value)
    assert re.search(words, message)
    assert "\n" not in message
    assert len(message) < 200


@pytest.mark.parametrize("points", [[[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0]], _ZIGZAG])
def test_a_closed_path_needs_an_area(points):
    with pytest.raises(PathError, match=r"at least|turns back"):
        Path.from_points(points, closed=True)


coordinates = st.one_of(
    st.integers(-400, 400).map(lambda n: n / 100.0),
    st.sampled_from([math.nan, math.inf, -math.inf, 1e9, -1e300, 1e-7, 5e-324, -0.0]),
)
any_shape = st.one_of(
    st.tuples(st.integers(0, 7), st.just(2)),
    npst.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
)


def path_or_refusal(points, closed):
    try:
        path = Path.from_points(points, closed)
    except PathError:
        return
    assert 0.0 < path.length < math.inf
    assert path.closed or closed is not True
    assert not (path.closed and closed is False)
    frame = path.frame(np.linspace(-1.0, path.length + 1.0, 500))
    assert np.isfinite(frame.pose).all()
    assert np.isfinite(frame.curvature).all()


@settings(max_examples=150)
@given(
    points=any_shape.flatmap(lambda shape: npst.arrays(float, shape, elements=coordinates)),
    closed=st.sampled_from([None, True, False]),
)
def test_any_array_makes_a_path_or_is_refused(points, closed):
    path_or_refusal(points, closed)


@settings(max_examples=150)
@given(
    points=npst.arrays(
        float,
        st.tuples(st.integers(2, 7), st.just(2)),
        elements=st.integers(-40, 40).map(lambda n: n / 10.0),
    ),
    closed=st.sampled_from([None, True, False]),
)
@example(points=np.array([[0.1, 0.0], [0.0, 0.0], [0.1, 0.0]]), closed=True)
def test_any_finite_points_make_a_path_or_are_refused(points, closed):
    path_or_refusal(points, closed)


@settings(max_examples=100)
@given(
    points=st.recursive(
        st.none()
        | st.booleans()
        | st.integers(-9, 9)
        | st.sampled_from([math.nan, math.inf, 1e300, 10**400])
        | st.text(max_size=3),
        lambda children: st.lists(children, max_size=4),
        max_leaves=8,
    )
)
@example(points=[[0.0, 1.0], [2.0]])
@example(points=[["0", "1"], ["x", "y"]])
def test_any_nested_list_makes_a_path_or_is_refused(points):
    path_or_refusal(points, None)
