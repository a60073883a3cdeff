"""Scrambled Sobol points in four dimensions: as scipy.stats makes them, without its import.

That import takes 0.4 s, more than all others of the controller but rclpy's, and nothing else of
scipy.stats is needed to drive.
"""

from __future__ import annotations

import numpy as np

from adp_path_follower.core.geometry import FloatArray

_BITS = 30
# Of Joe and Kuo: coefficients of a primitive polynomial after the leading one, and the first
# direction numbers. The first dimension has neither.
_DIMENSIONS: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = (
    ((), ()),
    ((1,), (1,)),
    ((1, 1), (1, 3)),
    ((0, 1, 1), (1, 3, 1)),
)


def scrambled_sobol_points(count: int, seed: int) -> FloatArray:
    """Return the first points of a Sobol sequence in the unit cube, shape (count, 4).

    Scrambled by a random linear matrix and a digital shift (Matousek 1998), the same for the same
    seed: the numbers that ``scipy.stats.qmc.Sobol(4, seed=seed)`` gives, to the last bit.

    Args:
        count: At most 2**30.
        seed: Not negative.

    """
    rng = np.random.default_rng(seed)
    dimensions = len(_DIMENSIONS)
    draws = rng.integers(2, size=(dimensions, _BITS), dtype=np.uint32)
    shift = draws @ (1 << np.arange(_BITS, dtype=np.uint32))
    matrices = np.tril(rng.integers(2, size=(dimensions, _BITS, _BITS), dtype=np.uint32), -1)
    matrices += np.eye(_BITS, dtype=np.uint32)
    places = np.arange(_BITS - 1, -1, -1, dtype=np.uint32)  # of bits, the highest first
    digits = (_direction_numbers()[:, None, :] >> places[:, None]) & 1
    scrambled = ((matrices @ digits & 1) << places[:, None]).sum(axis=1, dtype=np.uint32)
    numbers = np.arange(count, dtype=np.uint32)
    gray = numbers ^ (numbers >> 1)
    points = np.tile(shift, (count, 1))
    for bit in range(max(0, count - 1).bit_length()):
        chosen = (gray >> bit & 1).astype(bool)
        points[chosen] ^= scrambled[:, bit]
    return np.asarray(points * 2.0**-_BITS)


def _direction_numbers() -> np.ndarray:
    """Return what each bit of a point's number adds to the point, shape (4, bits)."""
    found = np.empty((len(_DIMENSIONS), _BITS), dtype=np.uint32)
    for row, (polynomial, first) in enumerate(_DIMENSIONS):
        numbers = list(first) or [1] * _BITS
        degree = len(polynomial)
        while len(numbers) < _BITS:
            following = numbers[-degree]
            for power, coefficient in enumerate(polynomial, start=1):
                following ^= coefficient * numbers[-power] << power
            numbers.append(following)
        found[row] = [number << _BITS - 1 - bit for bit, number in enumerate(numbers)]
    return found
