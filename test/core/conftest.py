"""What several tests of the core share: the paper's numbers, its path, and independent formulas."""

from __future__ import annotations

import math
from types import MappingProxyType

import numpy as np
import pytest

from adp_path_follower.core.path_library import lissajous

_PRINTED_WEIGHTS = (0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.5, 0.0, 1.0)


@pytest.fixture(scope="session")
def paper():
    """Return the paper's settings, all of them explicit and without limits of the command."""
    return MappingProxyType(
        {
            "desired_speed": 0.5,
            "target_gain": 0.1,
            "path_state_gain": 0.05,
            "state_cost": (1.0, 1.0, 1.0),
            "input_cost": (1.0, 1.0),
            "min_linear_vel": -math.inf,
            "max_linear_vel": math.inf,
            "max_angular_vel": math.inf,
            "learning": True,
            "basis": "paper",
            "critic_gain_measured": 0.5,
            "critic_gain_sampled": 10.0,
            "actor_gain": 5.0,
            "actor_weight_bound": 10.0,
            "sample_half_widths": (1.0, 1.0, 1.0, 0.5),
            "samples_per_axis": (3, 3, 3, 3),
            "initial_critic_weights": _PRINTED_WEIGHTS,
            "initial_actor_weights": _PRINTED_WEIGHTS,
        }
    )


@pytest.fixture(scope="session")
def figure_eight():
    """Return the product's figure eight."""
    return lissajous()


@pytest.fixture(scope="session")
def printed():
    """Return the paper's formulas, written from the paper and for one state at a time."""
    return PrintedFormulas()


class PrintedFormulas:
    """The formulas of the paper with its numbers, in plain Python."""

    v_des, k1, k2 = 0.5, 0.1, 0.05

    def drift(self, zeta, kappa):
        """Return f(zeta), row by row as it is printed."""
        s, y, theta, phi = (float(value) for value in zeta)
        v, k1, k2 = self.v_des, self.k1, self.k2
        return np.array(
            [
                kappa * y * v * math.cos(theta) + k1 * kappa * s * y - k1 * s,
                v * math.sin(theta) - kappa * s * v * math.cos(theta) - k1 * kappa * s**2,
                kappa * v - kappa * (v * math.cos(theta) + k1 * s),
                k2 * (1.0 - phi**2) * (v * math.cos(theta) + k1 * s),
            ]
        )

    def input_matrix(self, zeta):
        """Return g(zeta), shape (4, 2)."""
        theta = float(zeta[2])
        return np.array([[math.cos(theta), 0.0], [math.sin(theta), 0.0], [0.0, 1.0], [0.0, 0.0]])

    def gradient(self, zeta):
        """Return sigma' of [z1z2, z1z3, z1z4, z2z3, z2z4, z3z4, z1^2, z2^2, z3^2], (9, 4)."""
        s, y, theta, phi = (float(value) for value in zeta)
        return np.array(
            [
                [y, s, 0.0, 0.0],
                [theta, 0.0, s, 0.0],
                [phi, 0.0, 0.0, s],
                [0.0, theta, y, 0.0],
                [0.0, phi, 0.0, y],
                [0.0, 0.0, phi, theta],
                [2.0 * s, 0.0, 0.0, 0.0],
                [0.0, 2.0 * y, 0.0, 0.0],
                [0.0, 0.0, 2.0 * theta, 0.0],
            ]
        )
