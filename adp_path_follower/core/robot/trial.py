"""Judges whether a model explains the motion of the robot better than the ideal unicycle does."""

import math

from adp_path_follower.core.robot.history import CommandHistory
from adp_path_follower.core.robot.model import IDEAL, RobotModel, RobotState, advanced

_WINDOW = 0.6  # [s] of which motion is foretold from commands alone
_MEMORY = 0.2  # share of a window in the mean
_LENGTH = 0.3  # [m] of a lever that makes a turn comparable with a distance
_FLOOR = 0.002**2  # [m^2] of errors that tell nothing
_WORSE = 1.5  # times the ideal model's error ...
_TOO_MANY = 4  # windows since the start, at least, before a model is given up


class Trial:
    """Foretells the next window of the motion by both models, and keeps the mean errors."""

    def __init__(self) -> None:
        self.failed = False  # by worse errors than the ideal model's
        self._mine = self._ideal = 0.0  # mean squared errors [m^2]
        self._windows = 0
        self.restart()

    def restart(self) -> None:
        """Begin another window: the robot was not observed."""
        self._begun: tuple[float, RobotState, RobotModel] | None = None

    @property
    def explained(self) -> float:
        """Return which share of what the ideal model misses the model explains, at most 1."""
        if self._ideal <= _FLOOR:
            return 0.0
        return 1.0 - self._mine / self._ideal

    def observe(
        self, stamp: float, state: RobotState, model: RobotModel, history: CommandHistory
    ) -> None:
        """Take in the state at a time [s], and the model that holds then."""
        if self._begun is None or not 0.0 <= stamp - self._begun[0] <= 2.0 * _WINDOW:
            self._begun = (stamp, state, model)
            return
        start, before, foreteller = self._begun
        if stamp - start < _WINDOW:
            return
        self._begun = (stamp, state, model)
        late = start - foreteller.delay
        mine = advanced(foreteller, before, history.held(late, late + stamp - start))
        ideal = advanced(IDEAL, before, history.held(start, stamp))
        self._windows += 1
        share = max(_MEMORY, 1.0 / self._windows)
        self._mine += share * (_apart(mine, state) - self._mine)
        self._ideal += share * (_apart(ideal, state) - self._ideal)
        if self._windows >= _TOO_MANY:
            self.failed = self._mine > _WORSE * self._ideal + _FLOOR


def _apart(first: RobotState, second: RobotState) -> float:
    """Return the squared distance of two states' poses [m^2]."""
    turn = _LENGTH * math.remainder(first.theta - second.theta, math.tau)
    return (first.x - second.x) ** 2 + (first.y - second.y) ** 2 + turn * turn
