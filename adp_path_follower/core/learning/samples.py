"""Sampled states: a grid about the origin, or scattered Sobol points."""

import numpy as np

from adp_path_follower.core.geometry import FloatArray

_INNER_SHARE = 0.3  # of the samples: scaled towards the origin, where the linear policy is decided
_INNERMOST = 0.05  # of the region: the smallest of these scales
_BITS = 30
# By Joe and Kuo: coefficients of a primitive polynomial after the leading one, and the first
# direction numbers. The first dimension has neither.
_DIMENSIONS: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...] = (
    ((), ()),
    ((1,), (1,)),
    ((1, 1), (1, 3)),
    ((0, 1, 1), (1, 3, 1)),
)


def sample_grid(half_widths: tuple[float, ...], samples_per_axis: tuple[int, ...]) -> FloatArray:
    """Return the grid of sampled states about the origin, shape (N, 4)."""
    axes = [
        np.linspace(-width, width, count) if count > 1 else np.zeros(1)
        for width, count in zip(half_widths, samples_per_axis, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def scattered_samples(count: int, half_widths: FloatArray, seed: int) -> FloatArray:
    """Return scrambled Sobol states e in a box, a share drawn to the origin, (count, 3)."""
    points = scrambled_sobol_points(count, seed)
    inner = points[:, 3] / _INNER_SHARE
    scale = np.where(inner < 1.0, _INNERMOST**inner, 1.0)
    return np.asarray((2.0 * points[:, :3] - 1.0) * half_widths * scale[:, None])


def scrambled_sobol_points(count: int, seed: int) -> FloatArray:
    """Return the first points, at most 2**30, of a Sobol sequence in the unit cube, (count, 4).

    Scrambled by a random linear matrix and a digital shift (Matousek 1998). These are the numbers
    of ``scipy.stats.qmc.Sobol(4, seed=seed)`` to the last bit; scipy.stats is not used, as its
    import takes about as long as that of the whole controller.
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
    """Return the contribution of each bit of a point's number, shape (4, bits)."""
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
