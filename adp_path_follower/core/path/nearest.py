"""The place on a path nearest to a robot: on the whole path, or near the last place.

A path may cross itself, and the nearest place on the whole path would then jump from one branch to
the other. A search near the last place stays on its branch.
"""

from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray, tracking_error
from adp_path_follower.core.path.curve import Path

_NEWTON_STEPS = 4
_LEAST_SLOPE = 0.1  # of Newton's method, which has none at the centre of the path's curvature

_REACH = 1.0  # [m] to either side of the last place
_SPACING = 0.1  # [m] of the candidates there


@dataclass(frozen=True)
class Projection:
    """Poses beside a path; one row for each pose."""

    arc_length: FloatArray  # place abreast of the robot [m]; grows over the laps of a closed path
    cross_track: FloatArray  # distance from the path [m], positive to its left
    heading: FloatArray  # heading less that of the path [rad], in [-pi, pi)


def best_place(path: Path, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the arc lengths [m] on the whole path that fit poses (..., 3) best, and scores [m²].

    A heading error of 90 degrees counts like a metre: at a crossing of the path with itself, and
    between two lanes, the heading decides. Samples are compared, at most 2 cm apart up to 2 km.
    """
    samples = path.samples
    x, y, heading = (pose[..., index, None] for index in range(3))
    dx, dy = samples.x - x, samples.y - y
    along = samples.cos * np.cos(heading) + samples.sin * np.sin(heading)
    score = dx * dx + dy * dy + 1.0 - along
    best = np.argmin(score, axis=-1)
    return samples.arc_length[best], np.take_along_axis(score, best[..., None], axis=-1)[..., 0]


def place_near(path: Path, poses: FloatArray, last: FloatArray) -> FloatArray:
    """Return the arc lengths [m] nearest to poses (..., 3), within 1 m of the last ones (...)."""
    count = round(_REACH / _SPACING)
    candidates = np.asarray(last)[..., None] + np.linspace(-_REACH, _REACH, 2 * count + 1)
    return beside(path, poses, nearest_of(path, poses, candidates), 0.5 * _SPACING).arc_length


def beside(
    path: Path, poses: FloatArray, arc_length: FloatArray, longest_step: float
) -> Projection:
    """Return the exact places beside poses (..., 3) near given ones, by Newton's method.

    The search starts at an arc length [m] (...); its four steps are bounded by `longest_step` [m].
    """
    for _ in range(_NEWTON_STEPS):  # until the tangential error is 0
        frame = path.frame(arc_length)
        error = tracking_error(poses, frame.pose)
        slope = np.maximum(1.0 - frame.curvature * error[..., 1], _LEAST_SLOPE)
        arc_length = arc_length + np.clip(error[..., 0] / slope, -longest_step, longest_step)
    # Beyond the ends of an open path its tangents go on, so `y` is the distance from those.
    error = tracking_error(poses, path.frame(arc_length).pose)
    return Projection(np.asarray(arc_length), error[..., 1], error[..., 2])


def nearest_of(path: Path, poses: FloatArray, candidates: FloatArray) -> FloatArray:
    """Return the nearest of K candidates [m], shape (K,) or (..., K), to each pose, shape (...)."""
    points = path.frame(candidates).pose[..., :2]
    squared = ((poses[..., None, :2] - points) ** 2).sum(axis=-1)
    best = np.argmin(squared, axis=-1)[..., None]
    return np.take_along_axis(np.broadcast_to(candidates, squared.shape), best, axis=-1)[..., 0]
