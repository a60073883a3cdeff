"""Settled, past the transient, off the path: each definition against its sentence in the docs."""

import math

import numpy as np
import pytest

from adp_path_follower import criteria


def test_settled_is_an_error_below_five_hundredths_in_norm():
    errors = np.array([[0.03, 0.0, -0.039], [0.03, 0.0, 0.041], [0.0, math.nan, 0.0]])
    assert criteria.is_settled(errors).tolist() == [True, False, False]
    assert criteria.is_settled(errors.reshape(3, 1, 3)).shape == (3, 1)
    assert criteria.is_settled(np.array([0.0, -0.049, 0.0]))


@pytest.mark.parametrize(("duration", "expected"), [(60.0, 10.0), (30.0, 10.0), (12.0, 4.0)])
def test_the_transient_is_ten_seconds_or_a_third(duration, expected):
    assert criteria.transient(duration) == pytest.approx(expected)


def test_off_the_path_is_more_than_half_a_metre_to_either_side():
    distance = np.array([0.0, 0.5, -0.5, 0.51, -0.51, math.nan, math.inf])
    assert criteria.is_off_path(distance).tolist() == [False] * 3 + [True] * 4


def test_a_run_has_approached_at_a_share_of_its_start_or_at_a_centimetre():
    assert criteria.has_approached(np.array([-2.0, 0.11, -0.09])).tolist() == [False, False, True]
    assert criteria.has_approached(np.array([0.1, 0.011, 0.009])).tolist() == [False, False, True]
    assert criteria.has_approached(np.zeros(0)).shape == (0,)


def test_the_time_to_stay_counts_from_the_last_time_outside():
    time = np.array([2.0, 3.0, 4.0, 5.0])
    assert criteria.time_to_stay(time, np.array([False, True, False, True])) == 3.0
    assert criteria.time_to_stay(time, np.ones(4, dtype=bool)) == 0.0
    assert math.isinf(criteria.time_to_stay(time, np.array([True, True, True, False])))
