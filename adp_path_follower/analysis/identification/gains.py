"""Gains and bias: the localised pose against the integral of the encoders, over short windows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adp_path_follower.analysis.identification.estimate import Estimate, estimate
from adp_path_follower.analysis.identification.recording import Recording
from adp_path_follower.core.geometry import FloatArray

_WINDOW = 3.0  # [s]
_FEWEST = 6  # messages in a window
_GAP = 1.0  # [s] without odometry, after which a window cannot go on
_WORSE = 5.0  # times the usual error of a window that slipped, or whose pose jumped
_LEAST = 1e-4  # [m, rad] of noise, so that a simulated robot has some
_IDEAL = np.array([1.0, 1.0, 0.0])  # k_v, k_w, b
_UNKNOWN = np.array([0.1, 0.1, 0.1])  # standard deviations of what no drive has told


@dataclass(frozen=True)
class _Window:
    place: FloatArray  # x + i y less its mean, shape (N,)
    heading: FloatArray  # shape (N,)
    turned: FloatArray  # the encoders' turn and distance less their means, shape (N, 2)

    def missed(self, turning: FloatArray) -> FloatArray:
        """Return the error of the heading with k_w and b (2,), shape (N,)."""
        return np.asarray(self.heading - self.heading.mean() - self.turned @ turning)

    def way(self, turning: FloatArray) -> FloatArray:
        """Return the encoders' way x + i y with k_w and b (2,), less its mean, shape (N,)."""
        heading = self.heading.mean() + self.turned @ turning
        steps = np.diff(self.turned[:, 1]) * np.exp(0.5j * (heading[1:] + heading[:-1]))
        way = np.append(0.0, np.cumsum(steps))
        return np.asarray(way - way.mean())


def fit_gains(recordings: Sequence[Recording]) -> tuple[Estimate, FloatArray]:
    """Return k_v, k_w, b [rad/m] that bring encoders and poses together best, and the noise.

    That is the standard deviations of the pose's x or y [m] and of its heading [rad], shape (2,).
    """
    windows = [window for recording in recordings for window in _windows(recording)]
    if not windows:
        return Estimate(_IDEAL, 2.0 * _UNKNOWN), np.full(2, math.nan)
    turning = _turning(windows)
    sizes = np.array([np.std(item.missed(turning.values)) for item in windows])
    usual = max(float(np.median(sizes)), _LEAST)
    windows = [item for item, size in zip(windows, sizes, strict=True) if size <= _WORSE * usual]
    turning = _turning(windows)
    ways = [item.way(turning.values) for item in windows]
    way, place = np.concatenate(ways), np.concatenate([item.place for item in windows])
    error = way - place
    gain = estimate(
        _IDEAL[:1],
        np.append(error.real, error.imag),
        np.append(way.real, way.imag)[:, None],
        np.tile(_blocks(windows), 2),
        _UNKNOWN[:1],
    )
    astray = [item.place - gain.values * way for item, way in zip(windows, ways, strict=True)]
    missed = [item.missed(turning.values) for item in windows]
    return (
        Estimate(np.append(gain.values, turning.values), np.append(gain.room, turning.room)),
        np.array([_noise(astray) / math.sqrt(2.0), _noise(missed)]),
    )


def _turning(windows: Sequence[_Window]) -> Estimate:
    """Return k_w and b by least squares, near 1 and 0 where the drive does not tell."""
    missed = np.concatenate([item.missed(_IDEAL[1:]) for item in windows])
    turned = np.concatenate([item.turned for item in windows])
    return estimate(_IDEAL[1:], -missed, turned, _blocks(windows), _UNKNOWN[1:])


def _blocks(windows: Sequence[_Window]) -> np.ndarray:
    return np.repeat(np.arange(len(windows)), [len(item.place) for item in windows])


def _windows(recording: Recording) -> list[_Window]:
    """Return the parts of a recording in which the robot drives."""
    time, encoders = recording.time, recording.encoders
    steps = np.diff(time)[:, None]
    done = np.vstack([np.zeros(2), np.cumsum(0.5 * (encoders[1:] + encoders[:-1]) * steps, axis=0)])
    number = ((time - time[0]) / _WINDOW).astype(int)
    found = []
    for rows in np.split(np.arange(len(time)), np.flatnonzero(np.diff(number)) + 1):
        moved = np.ptp(done[rows], axis=0).max() if len(rows) >= _FEWEST else 0.0
        if moved < 0.05 or np.diff(time[rows]).max() > _GAP:
            continue
        place = recording.poses[rows, 0] + 1j * recording.poses[rows, 1]
        turned = done[rows][:, ::-1]
        found.append(
            _Window(place - place.mean(), recording.poses[rows, 2], turned - turned.mean(axis=0))
        )
    return found


def _noise(errors: Sequence[FloatArray]) -> float:
    """Return the standard deviation of what changes from one message to the next."""
    changes = np.concatenate([np.diff(item) for item in errors])
    return float(np.sqrt(0.5 * np.mean(np.abs(changes) ** 2)))
