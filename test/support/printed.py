"""The paper's formulas and numbers, written from the paper, independent of the product."""

from __future__ import annotations

import cmath
import itertools
import math
from types import MappingProxyType

import numpy as np

PRINTED_WEIGHTS = (0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.5, 0.0, 1.0)

PAPER_SETTINGS = MappingProxyType(
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
        "frame": "serret_frenet",
        "scheduling": "path_state",
        "critic": "gradient",
        "wide_region": "none",
        "fallback": "none",
        "initial_weights": "listed",
        "critic_gain_measured": 0.5,
        "critic_gain_sampled": 10.0,
        "actor_gain": 5.0,
        "actor_weight_bound": 10.0,
        "sample_half_widths": (1.0, 1.0, 1.0, 0.5),
        "samples_per_axis": (3, 3, 3, 3),
        "initial_critic_weights": PRINTED_WEIGHTS,
        "initial_actor_weights": PRINTED_WEIGHTS,
    }
)


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

    def policy(self, zeta, kappa, actor, input_cost, limits=(-math.inf, math.inf, math.inf)):
        """Return u of the actor, clipped so that the command keeps [v_min, v_max, w_max]."""
        descent = self.input_matrix(zeta).T @ self.gradient(zeta).T @ actor
        wanted = -0.5 * np.linalg.solve(input_cost, descent)
        steady = np.array([self.v_des, kappa * self.v_des])
        lowest, highest, turn = limits
        command = wanted + steady
        command = [
            min(max(command[0], lowest), highest),
            min(max(command[1], -turn), turn),
        ]
        return np.array(command) - steady

    def bellman_error(self, zeta, kappa, applied, critic, state_cost, input_cost):
        """Return delta, omega and p at a state with an input that is applied."""
        omega = self.gradient(zeta) @ (self.drift(zeta, kappa) + self.input_matrix(zeta) @ applied)
        error = np.array(zeta[:3])
        cost = error @ state_cost @ error + applied @ input_cost @ applied
        return cost + critic @ omega, omega, math.sqrt(1.0 + omega @ omega)

    def sampled_errors(self, values, path, critic, actor):
        """Return delta, omega and p of every sample of these settings, one after the other."""
        state_cost, input_cost = self.costs(values)
        limits = tuple(
            values[name] for name in ("min_linear_vel", "max_linear_vel", "max_angular_vel")
        )
        axes = [
            np.linspace(-width, width, count) if count > 1 else [0.0]
            for width, count in zip(
                values["sample_half_widths"], values["samples_per_axis"], strict=True
            )
        ]
        found = []
        for zeta in itertools.product(*axes):
            kappa = float(path.curvature(math.atanh(zeta[3]) / self.k2))
            applied = self.policy(zeta, kappa, actor, input_cost, limits)
            found.append(self.bellman_error(zeta, kappa, applied, critic, state_cost, input_cost))
        return found

    def costs(self, values):
        """Return Q and R of settings that give a diagonal or rows."""
        matrices = []
        for name, size in (("state_cost", 3), ("input_cost", 2)):
            entries = np.array(values[name], dtype=float)
            whole = len(entries) == size * size
            matrices.append(entries.reshape(size, size) if whole else np.diag(entries))
        return matrices

    def weight_rates(self, critic, actor, measured, sampled):
        """Return Wc' and Wa' inside the projection's ball, with the paper's gains."""
        gain_measured, gain_sampled, gain_actor = 0.5, 10.0, 5.0
        delta, omega, p = measured
        critic_rate = -gain_measured * omega * delta / p
        for delta, omega, p in sampled:
            critic_rate = critic_rate - gain_sampled / len(sampled) * omega * delta / p
        return critic_rate, -gain_actor * (actor - critic)


class ExplicitPolynomial:
    """All monomials of [s, y, theta] from degree 2 up, in plain Python for one state at a time."""

    def __init__(self, degree, frame):
        self.frame = frame
        self.exponents = sorted(
            (
                powers
                for powers in itertools.product(range(degree + 1), repeat=3)
                if 2 <= sum(powers) <= degree
            ),
            key=lambda powers: (sum(powers), [-power for power in powers]),
        )

    def value(self, error):
        """Return sigma at [s, y, theta], which may be complex."""
        s, y, theta = error
        if self.frame == "half_angle":
            # The position error as a complex number, turned backwards by half the heading error.
            cos, sin = cmath.cos(0.5 * theta), cmath.sin(0.5 * theta)
            s, y = s * cos + y * sin, -s * sin + y * cos
        return np.array([s**i * y**j * theta**k for i, j, k in self.exponents])

    def gradient(self, error):
        """Return sigma' with respect to s, y, theta by complex steps, shape (L, 3)."""
        step = 1e-30j * np.eye(3)
        return np.stack([self.value(error + step[i]).imag / 1e-30 for i in range(3)], axis=1)
