"""Times of messages that can be trusted: stamps where they are sound, else arrival.

Bags have stamps that are all zero or alike, of another clock, out of order, or that go back as a
simulator is reset. A note says what is done about each.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from adp_path_follower.bags.columns import Series
from adp_path_follower.core.geometry import FloatArray

_SECOND = 1_000_000_000
_OTHER_CLOCK = _SECOND  # [ns] between two times: they are of different clocks
_EARLY = _SECOND // 20  # [ns] that a stamp may be after its arrival: clocks differ by more
_WRONG = 2 * _SECOND  # [ns] that a stamp's delay differs from those around it
_AROUND = 9  # messages
_FEW = 0.05  # share of messages whose times may be mended one by one
_ALIKE = 0.02  # share of messages that may have the stamp of another
_RUN = 10  # messages that go on after time was set back; fewer were late
_LEAP = 3  # times the steps of arrival, and of others: stamps that leap ahead are of another clock
_LONGER = 1.02  # times the way in order of arrival: the order of the stamps is not that of motion
_GREATEST = 1e8  # [m, m/s, rad/s]


@dataclass(frozen=True)
class Timeline:
    """The messages of a topic in order of time."""

    series: Series  # the messages, of which no two have one time
    cut: np.ndarray  # where time was set back or ahead since the message before, shape (N,)
    # Times of all sound messages in order of arrival, repeated ones too [ns].
    all_stamps: np.ndarray
    all_arrivals: np.ndarray  # their arrival [ns]
    used: int  # how many messages count: all but what is not finite, or shares a time with another
    by_arrival: bool = False  # whether the stamps are of no use
    notes: tuple[str, ...] = ()  # sentences about what is wrong


class Clock:
    """Translates arrival into the clock of the odometry's stamps, where that is another."""

    def __init__(self, odometry: Timeline) -> None:
        stamps, arrivals = odometry.all_stamps, odometry.all_arrivals
        self.is_arrival = odometry.by_arrival
        delay = _median(arrivals - stamps) if len(stamps) else 0.0
        self._other = not -_EARLY < delay <= _OTHER_CLOCK
        self._tolerance = _OTHER_CLOCK if delay > -_EARLY else _EARLY
        if self._other:
            order = np.argsort(arrivals, kind="stable")
            self._origin, self._first = int(arrivals[order[0]]), int(stamps[order[0]])
            # Relative, for a double cannot hold nanoseconds since 1970.
            self._arrival = (arrivals[order] - self._origin).astype(float)
            self._stamp = (stamps[order] - self._first).astype(float)

    def differs(self, stamps: np.ndarray, mapped: np.ndarray) -> bool:
        """Return whether stamps [ns] are of another clock than their mapped arrivals."""
        return bool(len(stamps)) and abs(_median(stamps - mapped)) > self._tolerance

    def stamps(self, arrival: np.ndarray) -> np.ndarray:
        """Return stamps [ns] for arrivals [ns]."""
        if not self._other:
            return arrival
        moved = np.interp((arrival - self._origin).astype(float), self._arrival, self._stamp)
        return np.asarray(self._first + moved.astype(np.int64))


def timeline(series: Series, name: str, clock: Clock | None = None) -> Timeline:
    """Return messages in the order of times to trust; `clock` is the odometry's, else None."""
    # Finite, and no greater than a robot's place or speed can be; NaN is not below, either.
    sound = np.asarray((np.abs(series.values) < _GREATEST).all(axis=1))
    notes = []
    if not sound.all():
        notes.append(f"{name}: {int((~sound).sum())} messages are not finite: left out")
    stamps, arrivals, values = series.stamp[sound], series.arrival[sound], series.values[sound]
    # The odometry has stamps always; commands may have none.
    by_arrival = clock is not None and (clock.is_arrival or np.array_equal(stamps, arrivals))
    cut = np.zeros(len(stamps), dtype=bool)
    if not by_arrival and len(stamps):
        stamps, cut, said, by_arrival = _mended(stamps, arrivals, values)
        notes += [f"{name}: {text}" for text in said]
    if clock is not None:
        mapped = clock.stamps(arrivals)
        if by_arrival:
            stamps = mapped
        elif clock.differs(stamps, mapped):
            stamps, by_arrival = mapped, True
            notes.append(f"{name}: stamped by another clock than the odometry: arrival is used")
    if by_arrival:
        stamps = _rising(stamps)
    kept, late = _ordered(stamps, cut)
    used = len(stamps) - _alike(stamps, values)
    if late:
        notes.append(f"{name}: {late} messages are out of order: sorted by their stamps")
    ordered = Series(stamps[kept], values[kept], series.labels, arrivals[kept])
    return Timeline(ordered, cut[kept], stamps, arrivals, used, by_arrival, tuple(notes))


def timed_stamps(series: Series, clock: Clock) -> np.ndarray:
    """Return the times [ns] of the learner's messages by the odometry's clock, shape (N,)."""
    mapped = clock.stamps(series.arrival)
    same = np.array_equal(series.stamp, series.arrival)
    if same or not len(mapped):
        return mapped
    alike = len(np.unique(series.stamp)) < 0.5 * len(mapped)
    other = clock.differs(series.stamp, mapped)
    back = _starts(series.stamp, series.arrival) != [0]
    return mapped if alike or other or back else series.stamp


def _median(values: np.ndarray) -> float:
    return float(np.median(values))


def _rising(stamps: np.ndarray) -> np.ndarray:
    """Return arrivals [ns] of which no two are equal, so that no message is lost."""
    steps = np.arange(len(stamps))
    return np.asarray(np.maximum.accumulate(stamps - steps) + steps)


def _ordered(stamps: np.ndarray, cut: np.ndarray) -> tuple[np.ndarray, int]:
    """Return which messages to keep in order of time, each time once, and how many were late."""
    _, kept = np.unique(stamps, return_index=True)
    late = int((stamps < np.maximum.accumulate(stamps)).sum()) if len(stamps) else 0
    if cut.any():  # the message that begins a part may be repeated
        kept = np.union1d(kept, np.flatnonzero(cut))
        kept = kept[np.argsort(stamps[kept], kind="stable")]
    return kept, late


def _mended(
    stamps: np.ndarray, arrivals: np.ndarray, values: FloatArray
) -> tuple[np.ndarray, np.ndarray, list[str], bool]:
    """Return times [ns], where they were cut, what was wrong, and whether all are arrivals."""
    count = len(stamps)
    wrong = _outliers(stamps, arrivals)
    if wrong.mean() > _FEW:
        said = f"{int(wrong.sum())} of {count} messages have no sound stamp: arrival is used"
        return arrivals, np.zeros(count, dtype=bool), [said], True
    notes = []
    if wrong.any():
        notes.append(f"{int(wrong.sum())} messages have no sound stamp: their arrival is used")
        delay = np.interp(
            np.flatnonzero(wrong), np.flatnonzero(~wrong), (arrivals - stamps)[~wrong]
        )
        stamps = stamps.copy()
        stamps[wrong] = arrivals[wrong] - delay.astype(np.int64)
    starts = _starts(stamps, arrivals)
    for first, stop in zip(starts, [*starts[1:], count], strict=True):
        alike = _alike(stamps[first:stop], values[first:stop])
        if alike > _ALIKE * (stop - first):
            notes.append(f"{alike} of {count} messages have the stamp of another: arrival is used")
            cut = np.zeros(count, dtype=bool)
            return arrivals, cut, notes, True
    cut = np.zeros(count, dtype=bool)
    if len(starts) == 1:
        sorted_way = _way(values[np.argsort(stamps, kind="stable")])
        if sorted_way > _LONGER * _way(values):
            notes.append("the stamps are in another order than the motion: arrival is used")
            return arrivals, cut, notes, True
        return stamps, cut, notes, False
    steps = [f"{(stamps[at] - stamps[at - 1]) / _SECOND:+.1f} s" for at in starts[1:]]
    notes.append(
        f"time is set {', '.join(steps[:3])}{' and more' * (len(steps) > 3)}, as by a simulator's "
        "reset: cut there, and arrival used between the parts"
    )
    cut[starts[1:]] = True
    return _joined(stamps, arrivals, starts), cut, notes, False


def _outliers(stamps: np.ndarray, arrivals: np.ndarray) -> np.ndarray:
    """Return which stamps are beyond all that the messages around them have, (N,)."""
    delay = (arrivals - stamps).astype(float)
    usual = np.abs(delay - median_filter(delay, _AROUND, mode="nearest")) <= _WRONG
    stamped = stamps != 0  # simulated time may begin at 0, but arrives then, too
    if stamped.any():
        usual &= stamped | (np.abs(delay - np.median(delay[stamped])) <= _WRONG)
    if not usual.any():
        return ~usual
    low, high = stamps[usual].min() - _SECOND, stamps[usual].max() + _SECOND
    return np.asarray(~usual & ((stamps < low) | (stamps > high)))


def _starts(stamps: np.ndarray, arrivals: np.ndarray) -> list[int]:
    """Return at which messages the parts of one clock begin, the first among them."""
    steps, waits = np.diff(stamps), np.abs(np.diff(arrivals))
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else 0.0
    pace = usual / max(1.0, float(np.median(waits))) if len(waits) else 1.0  # of simulated time
    leaps = steps > 0.5 * _SECOND + _LEAP * np.maximum(pace * waits, usual)
    backward = np.flatnonzero(steps < 0) + 1
    delay = arrivals - stamps
    starts = [0]
    places = np.union1d(backward, np.flatnonzero(leaps) + 1).tolist()
    for at, following in zip(places, [*places[1:], len(stamps)], strict=False):
        if leaps[at - 1]:  # for good; after messages that were held up the delay is as before
            change = _median(delay[starts[-1] : at]) - _median(delay[at:following])
            if 2.0 * change > steps[at - 1]:
                starts.append(at)
            continue
        before = stamps[starts[-1] : at]
        after = np.searchsorted(backward, at, side="right")
        stop = int(backward[after]) if after < len(backward) else len(stamps)
        run = stamps[at:stop]
        run = run[: np.searchsorted(run, before.max())]
        if 2 * int((before > run[:1]).sum()) < min(2 * _RUN, len(before)):
            continue  # but for a few that came too early it goes on
        if len(run) < (_RUN if stop < len(stamps) else 3):
            continue
        shared = int(((before >= run[0]) & (before <= run[-1])).sum())
        if 2 * shared >= len(run) or run[-1] < before.min():  # else what was missing came late
            starts.append(at)
    return starts


def _way(values: FloatArray) -> float:
    """Return the length of the way through the first two columns of values (N, M)."""
    return float(np.hypot(*np.diff(values[:, :2], axis=0).T).sum())


def _alike(stamps: np.ndarray, values: FloatArray) -> int:
    """Return how many messages have the stamp of another whose content differs."""
    order = np.argsort(stamps, kind="stable")
    same = np.diff(stamps[order]) == 0
    differ = same & (np.diff(values[order], axis=0) != 0.0).any(axis=1)
    return int(differ.sum())


def _joined(stamps: np.ndarray, arrivals: np.ndarray, starts: Sequence[int]) -> np.ndarray:
    """Return the times of parts one behind the other, each from the arrival of its first [ns]."""
    found = np.empty_like(stamps)
    last = None
    for first, stop in zip(starts, [*starts[1:], len(stamps)], strict=True):
        offset = int(arrivals[first] - stamps[first])
        if last is not None:
            offset = max(offset, int(last - stamps[first:stop].min()) + 1)
        found[first:stop] = stamps[first:stop] + offset
        last = int(found[first:stop].max())
    return found
