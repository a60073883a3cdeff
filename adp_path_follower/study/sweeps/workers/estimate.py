"""TODO."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass

import numpy as np

from adp_path_follower.study.sweeps.request.sweep_file import Sweep
from adp_path_follower.study.sweeps.workers.cluster import workers
from adp_path_follower.study.sweeps.workers.plan import Plan
from adp_path_follower.study.sweeps.workers.runs import Batch, simulate_batch

_TIMED_PARTS = 3


@dataclass(frozen=True)
class Estimate:
    """How long a sweep will take.

    Attributes:
        workers: How many parts are worked off at once.
        seconds: Of computing time on all of them [s].
        seconds_each: Of a run, on one [s].

    """

    workers: int
    seconds: float
    seconds_each: float


def estimate(sweep: Sweep, address: str | None, count: int | None) -> Estimate:
    """Return how long a sweep will take, by a few of its batches on this machine.

    Raises:
        AdpError: The scheduler cannot be reached.

    """
    plan = Plan(sweep)
    numbers = np.unique(np.linspace(0, plan.parts - 1, _TIMED_PARTS).astype(int))
    batches = [plan.part(int(number)).batches[0] for number in numbers]
    each = batch_time(batches) / float(np.mean([len(batch) for batch in batches]))
    with workers(address, count) as found:
        at_once = found.count
    return Estimate(at_once, each * sweep.runs / min(at_once, plan.parts), each)


_SHORT, _LONG = 0.3, 0.9  # [s] of simulated time


def batch_time(batches: list[Batch]) -> float:
    """Return the mean computing time of batches [s], as if each ran for its whole duration.

    Each is simulated twice for a short time: what making the controller costs comes once, the
    control steps go on.
    """
    simulate_batch(dataclasses.replace(batches[0], duration=_SHORT))  # fills caches
    times = []
    for batch in batches:
        short, long = (_timed(batch, duration) for duration in (_SHORT, _LONG))
        rate = max(0.0, long - short) / (_LONG - _SHORT)
        times.append(short + rate * max(0.0, batch.duration - _SHORT))
    return float(np.mean(times))


def _timed(batch: Batch, duration: float) -> float:
    begun = time.perf_counter()
    simulate_batch(dataclasses.replace(batch, duration=duration))
    return time.perf_counter() - begun


def in_words(seconds: float) -> str:
    """Return a time as people say it."""
    if seconds < 90.0:
        return f"{max(1.0, seconds):.0f} s"
    if seconds < 5400.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"
