"""How far a robot drove, from odometry that may be noisy, sparse, or jump."""

import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray, sinc, wrap_angle

_LEAST_JUMP = 0.1  # [m] beyond what the robot may have driven
_JUMP_SPREAD = 8.0  # times the usual difference between a step and the velocity
_STRIDES, _USUAL = 3.0, 0.95  # times this quantile of the steps, where no velocity is known
_AGREEMENT = 2.0  # between velocity and steps, either way: else the velocity is of no use
_SHARP = 0.7  # [rad]: half of a turn from one pose to the next
_FILTER = 8.0  # times the noise: a smaller motion to and fro is none
_LEAST_STRIDE = 0.05  # [m] between the ends of chords that noise hardly lengthens
_NOISES = 20.0  # times the noise, likewise
_ACROSS = 0.97  # share of a track that the steps along the heading must explain
_ALIKE = 0.1  # share of the distance by which that of the velocity may be another, ...
_ALIKE_WITHIN = 0.3  # [m] ... and besides
_MOVING = 0.05  # [m/s]: the velocity of slower robots is mostly noise
_NOISE_OF_DIFFERENCES = 0.6745 * math.sqrt(6.0)  # median |second difference| of noise of 1


@dataclass(frozen=True)
class Motion:
    """The steps of a robot from each pose to the next."""

    along: FloatArray  # distance driven since the pose before, negative backwards [m], shape (N,)
    # Way beyond that, of a robot that turned back between two poses [m], shape (N,).
    hidden: FloatArray
    reach: FloatArray  # how far the robot may have driven since then [m], shape (N,)
    # Whether the robot, or its odometry, was put elsewhere in between, shape (N,).
    carried: np.ndarray
    # Distance since then by the velocity of a robot that moves [m], NaN if of no use, shape (N,).
    said: FloatArray
    noise: float  # standard deviation of the positions [m], as far as they tell
    position: FloatArray  # x, y [m], shape (N, 2)

    def distance(self, chosen: np.ndarray) -> float:
        """Return the length of the track over chosen poses (N,), without noise and jumps [m]."""
        total = 0.0
        jumps = np.flatnonzero(self.carried[chosen])  # as places among the chosen poses
        for rows in np.split(np.flatnonzero(chosen), jumps):
            if len(rows) > 1:
                there = np.cumsum(self.along[rows[1:]])
                own = _to_and_fro(np.concatenate([[0.0], there]), _FILTER * self.noise)
                chords = _chords(self.position[rows], max(_LEAST_STRIDE, _NOISES * self.noise))
                # A robot that moves sideways, or whose heading says nothing, has chords only.
                total += own if own >= _ACROSS * chords else chords
                total += float(self.hidden[rows[1:]].sum())
        return total

    def doubts(self) -> list[str]:
        """Return a sentence if poses and velocities tell of different distances."""
        moving = (np.abs(self.said) > 0.0) & ~self.carried
        found, said = self.distance(moving), float(np.abs(self.said[moving]).sum())
        if not abs(found - said) > _ALIKE * found + _ALIKE_WITHIN:
            return []
        return [
            f"the odometry's poses tell of {found:.4g} m, its velocities of {said:.4g} m: "
            "one of them is wrong, several nodes publish it, or the robot moves sideways"
        ]


def motion_of(time: FloatArray, poses: FloatArray, speed: FloatArray, cut: np.ndarray) -> Motion:
    """Return the motion between poses x [m], y [m], theta [rad] (N, 3) at times [s] (N,).

    A step along an arc of constant curvature is longer than its chord, whose direction is halfway
    between the headings at its ends. Noise across that direction counts for nothing, and noise
    along it cancels from step to step. `speed` is v [m/s] by the odometry, zero where it says none,
    and `cut` says where time was set back before a pose, shape (N,) each.
    """
    step = np.diff(poses[:, :2], axis=0, prepend=poses[:1, :2])
    period = np.diff(time, prepend=time[:1])
    half = 0.5 * wrap_angle(np.diff(poses[:, 2], prepend=poses[:1, 2]))
    middle = poses[:, 2] - half
    chord = step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)
    bend = np.maximum(sinc(half), 2.0 / math.pi)
    length = np.hypot(*step.T)
    before = np.concatenate([speed[:1], speed[:-1]])
    said = 0.5 * (speed + before) * period
    both = 0.5 * (np.abs(speed) + np.abs(before)) * period  # there and back
    if not _agrees(length, said):
        said = np.full(len(said), np.nan)
    carried = cut | _jumps(length, chord, bend, said, both)
    along = chord / bend
    sharp = (np.abs(half) > _SHARP) & np.isfinite(said)  # the step is no arc, and says little
    along = np.where(carried, 0.0, np.where(sharp, said, along))
    across = step[:, 1] * np.cos(middle) - step[:, 0] * np.sin(middle)
    noise = _noise(across, carried)
    turned = (speed * before < 0.0) & np.isfinite(said) & ~carried & (both > _FILTER * noise)
    hidden = np.where(turned, np.maximum(both - np.abs(along), 0.0), 0.0)
    reach = np.fmax(np.abs(along), np.abs(said))
    driven = np.where(both > _MOVING * period, said, 0.0)
    return Motion(along, hidden, reach, carried, driven, noise, poses[:, :2])


def _agrees(length: FloatArray, said: FloatArray) -> bool:
    """Return whether the velocity explains the steps: some odometry has none, or other units."""
    moving = np.abs(said) > 1e-6
    ratio = float(np.median(length[moving] / np.abs(said[moving]))) if moving.any() else 0.0
    return 1.0 / _AGREEMENT < ratio < _AGREEMENT


def _jumps(
    length: FloatArray, chord: FloatArray, bend: FloatArray, said: FloatArray, both: FloatArray
) -> np.ndarray:
    """Return which steps are longer than the robot can have driven, (N,)."""
    if np.isfinite(said).all():
        # The rest of a step, without the motion that the velocity explains.
        rest = np.hypot(chord - said * bend, np.sqrt(np.maximum(length**2 - chord**2, 0.0)))
        spread = float(np.median(rest[1:])) if len(rest) > 1 else 0.0
        return np.asarray(rest > _LEAST_JUMP + both + _JUMP_SPREAD * spread)
    usual = length[length > 1e-6]
    typical = float(np.quantile(usual, _USUAL)) if len(usual) else 0.0
    return np.asarray(length > _LEAST_JUMP + _STRIDES * typical)


def _noise(across: FloatArray, carried: np.ndarray) -> float:
    """Return the noise of positions [m]: how the steps across the heading differ, (N,)."""
    change = np.diff(across[1:])[~(carried[2:] | carried[1:-1])]
    return float(np.median(np.abs(change))) / _NOISE_OF_DIFFERENCES if len(change) else 0.0


def _to_and_fro(place: FloatArray, least: float) -> float:
    """Return the way along places (N,) of which turns by less than some distance are noise [m]."""
    if least <= 0.0:
        return float(np.abs(np.diff(place)).sum())
    total, turned, high, low = 0.0, float(place[0]), float(place[0]), float(place[0])
    direction = 0
    for here in place.tolist():
        high, low = max(high, here), min(low, here)
        if direction >= 0 and high - here > least:
            total += high - turned if direction else 0.0
            direction, turned, low = -1, high if direction else turned, here
        elif direction <= 0 and here - low > least:
            total += turned - low if direction else 0.0
            direction, turned, high = 1, low if direction else turned, here
    return total + abs(float(place[-1]) - turned if direction else 0.0)


def _chords(position: FloatArray, stride: float) -> float:
    """Return the length of a polyline through positions (N, 2) at least a stride apart [m]."""
    points = position.tolist()
    total, kept = 0.0, points[0]
    for here in points:
        gap = math.dist(here, kept)
        if gap >= stride:
            total, kept = total + gap, here
    return total + (math.dist(points[-1], kept) if total else 0.0)
