"""Which segment a recorded robot was on, against all ways there are, and against a known drive."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.analysis.followed import _monotone, segments_driven
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.settings.groups import PathSettings


@settings(max_examples=200)
@given(
    costs=st.integers(1, 3).flatmap(
        lambda columns: st.lists(
            st.lists(st.integers(0, 9), min_size=columns, max_size=columns),
            min_size=1,
            max_size=6,
        )
    )
)
def test_no_other_order_of_segments_is_nearer(costs):
    costs = np.array(costs, dtype=float)
    found = _monotone(costs)
    assert (np.diff(found) >= 0).all()
    rows = np.arange(len(costs))
    every = itertools.combinations_with_replacement(range(costs.shape[1]), len(costs))
    assert costs[rows, found].sum() == min(costs[rows, list(way)].sum() for way in every)


def test_there_and_back_the_same_way():
    """Backwards, and forwards again, with a robot that is 2 cm off and stops in between."""
    ahead = np.column_stack([np.linspace(0.0, 2.0, 41), np.zeros((41, 2))])
    message = np.vstack([ahead, ahead[-2::-1], ahead[1:]])
    route = prepare(message[:, :2], PathSettings(allow_reversing=True), message[:, 2])
    assert [segment.reverse for segment in route.segments] == [False, True, False]
    rest = np.repeat(ahead[-1:], 10, axis=0)
    poses = np.vstack([ahead, rest, ahead[::-1], ahead])
    poses += [0.0, 0.02, 0.05]
    speed = np.repeat([0.5, 0.0, -0.5, 0.5], [41, 10, 41, 41])
    found = segments_driven(route, poses, speed)
    assert (np.diff(found) >= 0).all()
    assert set(found[:40]) == {0}
    assert set(found[52:90]) == {1}
    assert set(found[95:]) == {2}


def test_nothing_and_one_segment():
    route = prepare([[0.0, 0.0], [1.0, 0.0]], PathSettings())
    assert segments_driven(route, np.zeros((0, 3)), np.zeros(0)).tolist() == []
    assert segments_driven(route, np.zeros((3, 3)), np.ones(3)).tolist() == [0, 0, 0]
