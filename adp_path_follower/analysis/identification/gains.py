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
_UNKNOWN = np.array([0.1, 0.1, 0.1])  # standard deviations of what no drive has told


@dataclass(frozen=True)
class Gains:
    """Gains and bias, with the noise of the pose."""

    values: Estimate  # k_v, k_w, b [rad/m]
    noise: FloatArray  # standard deviations of the pose's x or y [m] and heading [rad], shape (2,)


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


def fit_gains(recordings: Sequence[Recording]) -> Gains:
    """Return the gains and the bias that bring encoders and poses together best."""
    windows = [window for recording in recordings for window in _windows(recording)]
    if not windows:
        unknown = Estimate(np.array([1.0, 1.0, 0.0]), _UNKNOWN, 2.0)
        return Gains(unknown, np.full(2, math.nan))
    turning = _turning(windows)
    sizes = np.array([np.std(item.missed(turning)) for item in windows])
    kept = sizes <= _WORSE * max(float(np.median(sizes)), _LEAST)
    windows = [item for item, sound in zip(windows, kept, strict=True) if sound]
    turning = _turning(windows)
    missed = [item.missed(turning) for item in windows]
    ways = [item.way(turning) for item in windows]
    way, place = np.concatenate(ways), np.concatenate([item.place for item in windows])
    gain = float((way.conj() @ place).real / max(float((way.conj() @ way).real), 1e-12))
    astray = [item.place - gain * found for item, found in zip(windows, ways, strict=True)]
    block = np.repeat(np.arange(len(windows)), [len(item) for item in missed])
    turns = estimate(
        turning,
        *_scaled(np.concatenate(missed), np.concatenate([item.turned for item in windows])),
        block,
        _UNKNOWN[1:],
    )
    error = np.concatenate(astray)
    ahead = estimate(
        np.array([gain]),
        *_scaled(np.append(error.real, error.imag), np.append(way.real, way.imag)[:, None]),
        np.tile(block, 2),
        _UNKNOWN[:1],
    )
    values = Estimate(
        np.append(gain, turning), np.append(ahead.deviations, turns.deviations), turns.factor
    )
    return Gains(values, np.array([_noise(astray) / math.sqrt(2.0), _noise(missed)]))


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


def _turning(windows: Sequence[_Window]) -> FloatArray:
    """Return k_w and b by least squares, near 1 and 0 where the drive does not tell, shape (2,)."""
    turned = np.concatenate([item.turned for item in windows])
    missed = np.concatenate([item.missed(np.array([1.0, 0.0])) for item in windows])
    weak = (1e-3 / _UNKNOWN[1:]) ** 2
    change = np.linalg.solve(turned.T @ turned + np.diag(weak), turned.T @ missed)
    return np.array([1.0, 0.0]) + change


def _scaled(errors: FloatArray, slopes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return errors and slopes in standard deviations of the errors."""
    size = max(float(np.sqrt(np.mean(errors**2))), _LEAST)
    return errors / size, slopes / size


def _noise(errors: Sequence[FloatArray]) -> float:
    """Return the standard deviation of what changes from one message to the next."""
    changes = np.concatenate([np.diff(item) for item in errors])
    return float(np.sqrt(0.5 * np.mean(np.abs(changes) ** 2)))
