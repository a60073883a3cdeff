"""A value basis of your own, chosen by `basis: bounded`.

As a script:  python examples/own_basis.py
By command:   adp --plugin examples/own_basis.py simulate --set basis=bounded
In a node:    ADP_PLUGINS=examples/own_basis.py ros2 run adp_path_follower controller \
                  --ros-args -p basis:=bounded
"""

import sys

import numpy as np

import adp_path_follower as adp


class BoundedBasis:
    """The six quadratic terms, and two that grow slowly far from the path."""

    labels = ("s²", "s y", "s θ", "y²", "y θ", "θ²", "log(1 + y²)", "1 - cos θ")

    def value(self, error: np.ndarray) -> np.ndarray:
        """Return the terms at errors [s, y, theta] of shape (..., 3), shape (..., 8)."""
        s, y, theta = np.moveaxis(error, -1, 0)
        terms = [s * s, s * y, s * theta, y * y, y * theta, theta * theta]
        return np.stack([*terms, np.log1p(y * y), 1.0 - np.cos(theta)], axis=-1)

    def gradient(self, error: np.ndarray) -> np.ndarray:
        """Return their derivatives by s, y and theta, shape (..., 8, 3)."""
        s, y, theta = np.moveaxis(error, -1, 0)
        zero = np.zeros_like(s)
        rows = [
            (2.0 * s, zero, zero),
            (y, s, zero),
            (theta, zero, s),
            (zero, 2.0 * y, zero),
            (zero, theta, y),
            (zero, zero, 2.0 * theta),
            (zero, 2.0 * y / (1.0 + y * y), zero),
            (zero, zero, np.sin(theta)),
        ]
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


adp.register_basis("bounded", BoundedBasis)


def main(duration: float = 30.0) -> None:
    """Compare it with the polynomial of the same degree, from the paper's start."""
    for changes in ({"basis": "bounded"}, {"basis": "polynomial", "basis_degree": 2}):
        settings = adp.load_settings("default", **changes)
        print(changes, adp.simulate("lissajous", settings, duration=duration))


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
