"""Counts of what happened to a robot besides its control steps, as a configuration names them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Counts:
    """What happened since the node's start.

    Attributes:
        learning_resets: How often learning has been reset.
        restarts: How often following has begun anew from where the robot was then.
        stops: How often the robot has been told to stop after a command.

    """

    learning_resets: int = 0
    restarts: int = 0
    stops: int = 0
