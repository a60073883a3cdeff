"""Smooth a polyline within a tolerance: noise averaged, corners rounded, the rest left alone.

On an even grid it is smoothed by kernels of growing width: four box filters, near a Gaussian, of
bounded support, never negative, so nothing overshoots. Each place takes the first level that more
smoothing within the tolerance would not better: none where the curve is fair, the widest kernel at
a corner. Levels blend over the width of their kernels, so the curvature stays continuous; as every
level that takes part is within the tolerance there, so is the blend.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.points import in_blocks

_BOX_WIDTHS = (3, 5, 7, 11, 15, 21, 29, 41, 57, 79)  # [samples], of each level's four boxes
_SAMPLES_PER_TOLERANCE = 4
_LEAST_SAMPLES, _MOST_SAMPLES = 64, 120_000
_FAIR_RATIO = 1.2  # between curvatures that more smoothing need not even out
_EXACT_RATIO = 1.5  # likewise, where the alternative is to leave the spline through the points
_FAIR_DIFFERENCE = 0.1  # [1/m], likewise
_FAITHFUL = 0.1  # share of the tolerance that the spline may leave a chord by, to be followed
_TIGHT = 0.2  # curvature times tolerance from which on a bend is worth a second round
_FIRST_SHARE = 0.5  # of the tolerance, in the first of two rounds
_MARGIN = 0.97  # of the tolerance: the rest is for the spline between samples
_MODERATE = 0.96  # [rad]: the most that samples of a smooth curve turn at once
_LIKE_CHORDS = 3.0  # ratio of two chords' lengths up to which they are alike, and ...
_LIKE_BENDS = 0.3  # ... of two curvatures from which on
_CHORD_PLACES = np.array([0.125, 0.3, 0.5, 0.7, 0.875])  # where a chord is compared with the spline


@dataclass(frozen=True)
class Grid:
    """A curve at even steps of a parameter."""

    values: FloatArray  # points (M, 2) [m]; those of a closed curve do not repeat the first
    step: float  # between two of them, along the polyline [m]
    closed: bool  # whether the last one joins the first

    @property
    def mode(self) -> str:
        """Return how scipy's filters go on beyond the ends."""
        return "wrap" if self.closed else "nearest"

    def padded(self, count: int) -> FloatArray:
        """Return the points with so many more beyond each end, (M + 2 count, 2)."""
        around = ((count, count), (0, 0))
        if self.closed:
            return np.pad(self.values, around, mode="wrap")
        return np.pad(self.values, around, mode="reflect", reflect_type="odd")


@dataclass(frozen=True)
class Interpolation:
    """The C2 spline through points by their chord lengths."""

    spline: CubicSpline  # maps the parameter to points [m]
    parameter: FloatArray  # that of each point, (N,) [m]
    points: FloatArray  # shape (N, 2) [m]; those of a closed path end with the first
    closed: bool  # whether the path is closed
    moved: float = 0.0  # how far points may be from those that were given [m]

    def places(self, tolerance: float) -> tuple[FloatArray, float]:
        """Return parameters at even steps, fine enough for a tolerance [m], and the step."""
        length = float(self.parameter[-1])
        count = math.ceil(_SAMPLES_PER_TOLERANCE * length / tolerance)
        count = min(max(count, _LEAST_SAMPLES), _MOST_SAMPLES)
        step = length / count
        return np.asarray(np.arange(count + (not self.closed)) * step, dtype=float), step

    @cached_property
    def bulges(self) -> FloatArray:
        """Return how far the spline leaves each chord [m], shape (N - 1,)."""
        start, chord = self.points[:-1], np.diff(self.points, axis=0)
        lengths = np.diff(self.parameter)
        farthest = np.zeros(len(chord))
        for place in _CHORD_PLACES:
            offset = in_blocks(self.spline, self.parameter[:-1] + place * lengths) - start
            share = np.clip((offset * chord).sum(axis=1) / lengths**2, 0.0, 1.0)
            gap = offset - share[:, None] * chord
            farthest = np.maximum(farthest, np.hypot(gap[:, 0], gap[:, 1]))
        return farthest

    @cached_property
    def excess(self) -> FloatArray:
        """Return the bulges where they are not the curve's own, else 0, shape (N - 1,) [m]."""
        return np.where(_sampled(self.points, self.closed), 0.0, self.bulges)


def bends(points: FloatArray, closed: bool) -> FloatArray:
    """Return the turn from each chord to the next by their mean length [1/m], positive to the left.

    One for each inner point of points (N, 2), and for the first of a closed path, which ends there.
    """
    chords = np.diff(points, axis=0)
    before, after = (np.roll(chords, 1, axis=0), chords) if closed else (chords[:-1], chords[1:])
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    turn = np.arctan2(cross, (before * after).sum(axis=1))
    return np.asarray(2.0 * turn / (np.hypot(*before.T) + np.hypot(*after.T)))


def _sampled(points: FloatArray, closed: bool) -> np.ndarray:
    """Return which chords of points (N, 2) are those of a smooth curve in samples, (N - 1,).

    Three or more turns in a row to one side, all of them moderate, of like size and between chords
    of like length, are a curve in samples; a corner turns at once, between straight pieces.
    """
    mode: Literal["wrap", "constant"] = "wrap" if closed else "constant"
    lengths, found = np.hypot(*np.diff(points, axis=0).T), bends(points, closed)
    if not len(found):
        return np.zeros(len(lengths), dtype=bool)
    first, second = (np.roll(lengths, 1), lengths) if closed else (lengths[:-1], lengths[1:])
    alike = np.maximum(first, second) <= _LIKE_CHORDS * np.minimum(first, second)
    alike &= 0.5 * np.abs(found) * (first + second) <= _MODERATE
    bend = np.pad(np.where(alike, found, 0.0), 1, mode=mode)
    left, here, right = bend[:-2], bend[1:-1], bend[2:]
    most = np.maximum(left * np.sign(here), right * np.sign(here))  # of both neighbours
    inside = (left * here > 0.0) & (right * here > 0.0)
    around = np.pad(inside, 1, mode=mode)
    in_a_row = inside | around[:-2] | around[2:]  # three of them
    curved = alike & in_a_row & (here != 0.0) & (most >= _LIKE_BENDS * np.abs(here))
    little = np.abs(here) <= _LIKE_BENDS * np.maximum(np.abs(left), np.abs(right))
    gentle = curved | (alike & little)  # where a curve begins or ends
    if closed:
        return np.asarray(gentle & np.roll(gentle, -1) & (curved | np.roll(curved, -1)))
    both = gentle[:-1] & gentle[1:] & (curved[:-1] | curved[1:])
    return np.concatenate([curved[:1], both, curved[-1:]])


def is_fair(through: Interpolation, tolerance: float) -> bool:
    """Return whether a spline is near its polyline, and smoothing would hardly straighten it."""
    if through.excess.max() > tolerance - through.moved:
        return False
    places, step = through.places(tolerance)
    along = in_blocks(through.spline, places)
    budget = np.full(len(places), tolerance)
    grid = Grid(along, step, through.closed)
    levels = _levels(grid, along, budget)
    next(levels)  # the curve itself
    worst = _bend(grid)  # of the levels so far
    for level, (curve, share) in enumerate(levels, start=1):
        bend = _bend(replace(grid, values=curve))
        better = worst > _EXACT_RATIO * _around(bend, level, grid.mode) + _FAIR_DIFFERENCE
        better &= share > 0.0
        if not through.closed:  # the kernel straightens an open curve's ends, whatever their bend
            reach = 4 * _BOX_WIDTHS[level - 1]
            better[:reach] = better[-reach:] = False
        if better.any():
            return False
        worst = np.maximum(worst, bend)
    return True


def smoothed(through: Interpolation, tolerance: float) -> tuple[FloatArray, float]:
    """Return a smooth curve within a tolerance [m] of points and their polyline, and its step [m].

    Its points are dense, shape (M, 2); those of a closed one end with the first.
    """
    points, parameter, closed = through.points, through.parameter, through.closed
    places, step = through.places(tolerance)
    bulge = through.excess
    chord = np.clip(np.searchsorted(parameter, places, side="right") - 1, 0, len(bulge) - 1)
    faithful = (bulge <= _FAITHFUL * tolerance)[chord]
    straight = np.stack([np.interp(places, parameter, points[:, axis]) for axis in (0, 1)], axis=1)
    anchor = np.where(faithful[:, None], in_blocks(through.spline, places), straight)
    limit = _MARGIN * tolerance - np.where(faithful, bulge[chord], 0.0)
    budget = limit - _beside(anchor, places, points, parameter)
    grid = Grid(anchor, step, closed)
    once = _round(grid, anchor, _FIRST_SHARE * budget)
    if _bend(once).max() * tolerance < _TIGHT:
        return _ended(_round(grid, anchor, budget))
    # Kernels over the polyline's length pinch a sharp corner; over that of a curve which cuts it
    # already, they hardly do.
    again, place = _even(once)
    anchor = _interpolated(anchor, place, closed)
    limit = _interpolated(limit[:, None], place, closed)[:, 0]
    budget = limit - _beside(anchor, step * place, points, parameter)
    return _ended(_round(again, anchor, budget))


def _round(grid: Grid, anchor: FloatArray, budget: FloatArray) -> Grid:
    """Return the grid's curve smoothed, within a budget (M,) [m] of the anchor (M, 2)."""
    curves, shares = zip(*_levels(grid, anchor, budget), strict=True)
    curve = grid.values
    for level, wanted in enumerate(_wanted(grid, curves, shares), start=1):
        if not wanted.any():
            break
        width, mode = _BOX_WIDTHS[level - 1], grid.mode
        size = min(12 * width + 1, len(curve))
        zone = maximum_filter1d(wanted.astype(np.uint8), size, mode=mode) * shares[level]
        core = minimum_filter1d(zone, min(4 * width + 1, len(zone)), mode=mode)
        weight = _four_boxes(core, width, mode)
        curve = curve + weight[:, None] * (curves[level] - curves[level - 1])
    return replace(grid, values=curve)


def _ended(grid: Grid) -> tuple[FloatArray, float]:
    """Return the points of a grid, those of a closed curve with the first at the end, and step."""
    repeated = grid.values[: 1 if grid.closed else 0]
    return np.vstack([grid.values, repeated]), grid.step


def _even(grid: Grid) -> tuple[Grid, FloatArray]:
    """Return a curve at even steps of its own length, and the place of each in samples, (M,)."""
    points, _ = _ended(grid)
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    count = len(grid.values)
    step = float(lengths[-1]) / (count if grid.closed else count - 1)
    place = np.interp(np.arange(count) * step, lengths, np.arange(len(points), dtype=float))
    # Cubic between the samples: a chord's corners would be bends.
    spline = CubicSpline(
        np.arange(len(points)), points, bc_type="periodic" if grid.closed else "not-a-knot"
    )
    return Grid(in_blocks(spline, place), step, grid.closed), place


def _interpolated(values: FloatArray, place: FloatArray, closed: bool) -> FloatArray:
    """Return values (M, K) at places between the samples (M,)."""
    whole = np.vstack([values, values[:1]]) if closed else values
    index = np.arange(len(whole))
    return np.stack([np.interp(place, index, column) for column in whole.T], axis=1)


def _beside(
    samples: FloatArray, places: FloatArray, points: FloatArray, parameter: FloatArray
) -> FloatArray:
    """Return how far points are from the polyline of samples, at the samples beside them, (M,).

    Samples (M, 2) [m] are at increasing places (M,) [m] along the polyline of the points; points
    (N, 2) [m], whose last is the first if the path is closed, are at a parameter (N,) [m].
    """
    count = len(samples)
    before = np.clip(np.searchsorted(places, parameter, side="right") - 1, 0, count - 1)
    after = (before + 1) % count  # beyond the last sample a closed path goes on with the first
    ends = np.append(places, max(parameter[-1], places[-1]))
    share = (parameter - places[before]) / np.maximum(ends[before + 1] - places[before], 1e-12)
    nearby = samples[before] + share[:, None] * (samples[after] - samples[before])
    gap = np.hypot(*(nearby - points).T)
    found = np.zeros(count)
    np.maximum.at(found, before, gap)
    np.maximum.at(found, after, gap)
    return found


def _levels(
    grid: Grid, anchor: FloatArray, budget: FloatArray
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield the curve of each level (M, 2), the first unsmoothed, and the share that it may have.

    The share (M,) is that of its step from the level before: 1 where it keeps to the budget within
    the kernel's reach, less where only a part of the step does.
    """
    values, mode = grid.values, grid.mode
    share = np.ones(len(values))
    yield values, share
    moved = np.hypot(*(values - anchor).T)
    for width in _BOX_WIDTHS:
        reach = 2 * (width - 1)
        if reach >= len(values) - 1:
            return
        curve = _four_boxes(grid.padded(reach), width, "nearest")[reach:-reach]
        before, moved = moved, np.hypot(*(curve - anchor).T)
        beyond = moved > budget
        share = (share == 1.0).astype(float)
        if beyond.any():
            part = np.clip(budget[beyond] - before[beyond], 0.0, None)
            share[beyond] *= part / np.maximum(moved[beyond] - before[beyond], 1e-12).clip(part)
            share = minimum_filter1d(share, min(2 * reach + 1, len(share)), mode=mode)
        if not share.any():
            return
        yield curve, share


def _wanted(
    grid: Grid, curves: Sequence[FloatArray], shares: Sequence[FloatArray]
) -> list[np.ndarray]:
    """Return where each level but the first, or a higher one, is better than those below, (M,)."""
    bends = [_bend(replace(grid, values=curve)) for curve in curves]
    best = np.full(len(bends[0]), np.inf)  # curvature of the higher levels, where permitted
    higher = np.zeros(len(best), dtype=bool)
    wanted = []
    for level in range(len(bends) - 1, 0, -1):
        around = _around(bends[level], level, grid.mode)
        best = np.where(shares[level] > 0.0, np.minimum(best, around), best)
        higher = higher | (bends[level - 1] > _FAIR_RATIO * best + _FAIR_DIFFERENCE)
        wanted.append(higher)
    return wanted[::-1]


def _around(bend: FloatArray, level: int, mode: str) -> FloatArray:
    """Return the greatest of a level's curvatures within the reach of its kernel, (M,)."""
    size = min(4 * _BOX_WIDTHS[level - 1] - 3, len(bend))
    return np.asarray(maximum_filter1d(bend, size, mode=mode))


def _bend(grid: Grid) -> FloatArray:
    """Return the curvature of a grid's curve, without sign [1/m], shape (M,)."""
    around = grid.padded(1)
    second = around[2:] - 2.0 * around[1:-1] + around[:-2]
    return np.hypot(second[:, 0], second[:, 1]) / grid.step**2


def _four_boxes(values: FloatArray, width: int, mode: str) -> FloatArray:
    for _ in range(4):
        values = uniform_filter1d(values, width, axis=0, mode=mode)
    return values
