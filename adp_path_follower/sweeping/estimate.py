"""How long a sweep will take, from a few of its batches over a short time."""

from __future__ import annotations

import dataclasses
import time

import numpy as np

from adp_path_follower.sweeping.runs import Batch, simulate_batch

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
