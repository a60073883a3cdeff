"""The course of simulated runs, step by step."""

import math
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np

from adp_path_follower.core.driving.output import ControlOutput, FollowerOutput
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.learning.weights import Weights


@dataclass(frozen=True)
class Trajectories:
    """The course of B runs over T control steps."""

    time: FloatArray  # time since the start [s], shape (T,)
    pose: FloatArray  # true pose, shape (B, T, 3)
    error: FloatArray  # e = [s, y, theta], shape (B, T, 3)
    arc_length: FloatArray  # s_p [m], shape (B, T)
    command: FloatArray  # [v, w], shape (B, T, 2)
    modified_input: FloatArray  # u = [v_e, w_e], shape (B, T, 2)
    cost: FloatArray  # J until then, along the true motion, shape (B, T)
    critic_weights: FloatArray  # Wc, shape (B, T, L); L = 0 without, or where none were wanted
    actor_weights: FloatArray  # Wa, shape (B, T, L)
    bellman_error: FloatArray  # delta at the state, shape (B, T); NaN for controllers without


class TrajectoryRecorder:
    """Records the course of runs, block by block."""

    def __init__(self, runs: int, steps: int, period: float, weights: bool) -> None:
        """Expect so many runs of so many control steps, a period [s] apart."""
        self._runs, self._steps, self._period = runs, steps, period
        self._columns = slice(None if weights else 0)  # of the weights
        self._arrays: dict[str, FloatArray] = {}

    def note(
        self, first_run: int, step: int, output: ControlOutput, pose: FloatArray, cost: FloatArray
    ) -> None:
        """Record a step of n runs from a first one on: true poses (n, 3) and J until then (n,)."""
        weights, unknown = weights_of(output), np.full(len(pose), math.nan)
        values = {
            "pose": pose,
            "error": output.error,
            "arc_length": output.arc_length,
            "command": output.command,
            "modified_input": output.modified_input,
            "cost": cost,
            "critic_weights": weights.critic[:, self._columns],
            "actor_weights": weights.actor[:, self._columns],
            "bellman_error": getattr(output, "bellman_error", unknown),
        }
        runs = slice(first_run, first_run + len(pose))
        for name, value in values.items():
            if name not in self._arrays:
                self._arrays[name] = np.empty((self._runs, self._steps, *value.shape[1:]))
            self._arrays[name][runs, step] = value

    def trajectories(self) -> Trajectories:
        """Return what was taken down of all runs."""
        time = np.arange(self._steps, dtype=float) * self._period
        return Trajectories(time=time, **self._arrays)


def weights_of(output: ControlOutput) -> Weights:
    """Return the weights of an output, one set for each run, shape (..., L) each."""
    batch = output.error.shape[:-1]
    if not isinstance(output, FollowerOutput):
        none = np.zeros((*batch, 0))
        return Weights(none, none)

    def repeated(values: FloatArray) -> FloatArray:
        return np.broadcast_to(values, (*batch, values.shape[-1]))

    return Weights(repeated(output.weights.critic), repeated(output.weights.actor))


def batch_of_one(values: Any) -> Any:
    """Return the values of one robot, a dataclass, as those of a batch of one."""
    found = {}
    for item in fields(values):
        value = getattr(values, item.name)
        if is_dataclass(value):
            found[item.name] = batch_of_one(value)
        elif isinstance(value, np.ndarray | np.generic):
            found[item.name] = np.asarray(value)[None]
    return replace(values, **found)
