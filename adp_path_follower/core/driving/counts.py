"""Counts of resets, restarts and stops, as a configuration names them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Counts:
    """How often a robot was interfered with since the node's start."""

    learning_resets: int = 0  # how often learning has been reset
    restarts: int = 0  # how often following has begun anew from where the robot was then
    stops: int = 0  # how often the robot has been told to stop after a command
