"""Estimates how long a sweep takes, from a few of its batches."""

import time
from dataclasses import dataclass, replace

import numpy as np

from adp_path_follower.study.sweeps.request.request import Sweep
from adp_path_follower.study.sweeps.workers.cluster import workers
from adp_path_follower.study.sweeps.workers.plan import Plan
from adp_path_follower.study.sweeps.workers.runs import Batch, simulate_batch

_TIMED_PARTS = 3
_SHORT, _LONG = 0.3, 0.9  # [s] of simulated time


@dataclass(frozen=True)
class Estimate:
    """Expected computing time of a sweep."""

    workers: int  # number of parts that run at once
    seconds: float  # computing time on all workers [s]
    seconds_each: float  # computing time of a run on one worker [s]


def estimate(sweep: Sweep, address: str | None, count: int | None) -> Estimate:
    """Return the computing time of a sweep, measured with a few of its batches on this machine.

    Raises AdpError if the scheduler cannot be reached.
    """
    plan = Plan(sweep)
    numbers = np.unique(np.linspace(0, plan.parts - 1, _TIMED_PARTS).astype(int))
    batches = [plan.part(int(number)).batches[0] for number in numbers]
    _timed(batches[0], _SHORT)  # fills caches
    # Making the controller costs time once, control steps cost time again and again.
    shorts, longs = (
        np.array([_timed(batch, duration) for batch in batches]) for duration in (_SHORT, _LONG)
    )
    rate = np.maximum(0.0, longs - shorts) / (_LONG - _SHORT)
    seconds = shorts + rate * max(0.0, sweep.conditions.run.duration - _SHORT)
    each = float(np.mean(seconds) / np.mean([len(batch) for batch in batches]))
    with workers(address, count) as found:
        at_once = found.count
    return Estimate(at_once, each * sweep.runs / min(at_once, plan.parts), each)


def in_words(seconds: float) -> str:
    """Return a time in seconds, minutes or hours."""
    if seconds < 90.0:
        return f"{max(1.0, seconds):.0f} s"
    if seconds < 5400.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.1f} h"


def _timed(batch: Batch, duration: float) -> float:
    """Return the computing time [s] of a batch over a simulated duration [s]."""
    begun = time.perf_counter()
    simulate_batch(replace(batch, run=replace(batch.run, duration=duration)))
    return time.perf_counter() - begun
