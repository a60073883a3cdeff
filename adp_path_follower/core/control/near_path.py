"""Holds a robot that is not ideal on its path.

No model knows slip, uneven floors and the last per cent of the wheels. They push the robot beside
the path, where a quadratic cost hardly asks it to return: 1 cm costs next to nothing. Therefore the
Riccati policy of a cost with a larger weight of y is added within `tight_within` of the path, less
that of the cost itself. Farther away it fades: there the cost decides how to come to the path.
"""

import dataclasses

import numpy as np

from adp_path_follower.core.control.policy import saturate
from adp_path_follower.core.control.riccati import RiccatiSchedule
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.settings.groups import Settings

_WEIGHT = 120.0  # [1/m^2] of y at least, as a multiple of the cost of the turn rate


class NearPath:
    """Adds to the input what a larger cost of y asks for, close to the path."""

    def __init__(self, settings: Settings, riccati: RiccatiSchedule) -> None:
        self._reach, self._limits = settings.policy.tight_within, settings.limits
        self._inverse = settings.cost.inverse_input_cost()
        cost = settings.cost.state_cost_matrix()
        cost[1, 1] = max(cost[1, 1], _WEIGHT * settings.cost.input_cost_matrix()[1, 1])
        tight = dataclasses.replace(settings.cost, state_cost=tuple(cost.ravel().tolist()))
        self._more = RiccatiSchedule(riccati.path, settings.target, tight, riccati.profile)
        self._more.table = self._more.table - riccati.table

    def held(
        self, u: FloatArray, zeta: FloatArray, curvature: FloatArray, feedforward: FloatArray
    ) -> FloatArray:
        """Return the input u (..., 2) and the turn that the larger cost adds to it.

        It is -R^-1 [0, dP_theta [0, y, theta]] with the difference dP of both Riccati solutions,
        and y and theta of the state zeta (..., 4), times the square of `tight_within` by their size
        beyond it.
        """
        sideways = zeta[..., 1:3]
        size = np.sqrt((sideways * sideways).sum(axis=-1, keepdims=True))
        near = sideways * (self._reach / np.maximum(size, self._reach)) ** 2
        more = self._more.matrix(curvature, feedforward[..., 0])[..., 2, 1:3]
        turn = (more * near).sum(axis=-1, keepdims=True)
        return saturate(u - turn * self._inverse[:, 1], feedforward, self._limits)
