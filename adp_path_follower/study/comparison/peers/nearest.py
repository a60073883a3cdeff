"""The place of a path nearest to a robot, and the one that it looks ahead to.

Both are searched near the last place only: the figure eight crosses itself, and the nearest point
of the whole path would jump from one branch to the other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from adp_path_follower.core.geometry import FloatArray, tracking_error
from adp_path_follower.core.path.curve import Path

_REACH = 1.0  # [m] to either side of the last place
_SPACING = 0.1  # [m] of the candidates there
_CANDIDATES = np.linspace(-_REACH, _REACH, round(2.0 * _REACH / _SPACING) + 1)
_NEWTON_STEPS = 4
_LEAST_SLOPE = 0.1  # of Newton's method, which has none at the centre of the path's curvature

# A chord is no shorter than 2 / pi of its arc, up to half a circle; the rest is for a bent path.
_ARC_OF_CHORD = 1.7
_LOOK_AHEAD_SAMPLES = 35
_BISECTIONS = 12


class NearestPlace:
    """The arc length nearest to each robot, from the last one on.

    Attributes:
        arc_length: Of the nearest place [m], shape (B,).

    """

    def __init__(self, path: Path, arc_length: ArrayLike) -> None:
        """Start the search at arc lengths [m], shape (B,)."""
        self.arc_length = np.asarray(arc_length, dtype=float)
        self._path = path

    def move(self, pose: FloatArray) -> FloatArray:
        """Search for poses (B, 3); return the arc length of the nearest place [m], shape (B,)."""
        last = np.broadcast_to(self.arc_length, pose.shape[:-1])
        candidates = last[..., None] + _CANDIDATES
        nearest = np.argmin(_distance(self._path, pose, candidates), axis=-1)
        place = last + _CANDIDATES[nearest]
        for _ in range(_NEWTON_STEPS):  # until the tangential error is 0
            frame = self._path.frame(place)
            error = tracking_error(pose, frame.pose)
            slope = np.maximum(1.0 - frame.curvature * error[..., 1], _LEAST_SLOPE)
            place = place + np.clip(error[..., 0] / slope, -0.5 * _SPACING, 0.5 * _SPACING)
        self.arc_length = np.asarray(place)
        return self.arc_length

    def ahead(self, pose: FloatArray, distance: ArrayLike) -> FloatArray:
        """Return the arc length [m] of the place looked ahead to, shape (B,).

        That is the first one from the nearest place on that is a distance [m] away from the
        robot: the nearest place itself, if the robot is farther from the path; the farthest one
        in reach, if a bend is too tight for any to be that far away.
        """
        distance = np.broadcast_to(np.asarray(distance, dtype=float), pose.shape[:-1])
        span = _ARC_OF_CHORD * distance[..., None]
        samples = self.arc_length[..., None] + span * np.linspace(0.0, 1.0, _LOOK_AHEAD_SAMPLES)
        distances = _distance(self._path, pose, samples)
        reached = distances >= distance[..., None]
        some = reached.any(axis=-1)
        index = np.where(some, np.argmax(reached, axis=-1), np.argmax(distances, axis=-1))
        high = np.take_along_axis(samples, index[..., None], axis=-1)[..., 0]
        low = np.take_along_axis(samples, np.maximum(index - 1, 0)[..., None], axis=-1)[..., 0]
        low = np.where(some, low, high)
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            beyond = _distance(self._path, pose, middle[..., None])[..., 0] >= distance
            low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
        return np.asarray(high)


def _distance(path: Path, pose: FloatArray, arc_length: FloatArray) -> FloatArray:
    """Return the distance [m] of poses (B, 3) to each of their K places (B, K), shape (B, K)."""
    away = path.frame(arc_length).pose[..., :2] - pose[..., None, :2]
    return np.hypot(away[..., 0], away[..., 1])
