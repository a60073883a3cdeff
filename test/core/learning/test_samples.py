"""Scrambled Sobol points, beside scipy's."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import qmc

from adp_path_follower.core.learning.samples import scrambled_sobol_points


@given(count=st.integers(1, 5000), seed=st.integers(0, 2**64))
def test_points_are_scipys_to_the_last_bit(count, seed):
    expected = qmc.Sobol(4, seed=seed).random(2 ** math.ceil(math.log2(count)))[:count]
    assert np.array_equal(scrambled_sobol_points(count, seed), expected)
