"""Routes: the paths that a robot drives one after the other, forwards or backwards."""

import hashlib
import math
from dataclasses import dataclass

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.nearest import best_place
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import update

_HALF_TURN: FloatArray = np.array([0.0, 0.0, np.pi])
_COMMAND_SIGNS: FloatArray = np.array([-1.0, 1.0])  # of v and w
_ERROR_SIGNS: FloatArray = np.array([-1.0, -1.0, 1.0])  # of s, y and theta


def turned_pose(pose: FloatArray) -> FloatArray:
    """Return poses [x, y, theta], shape (..., 3), with the opposite heading."""
    return pose + _HALF_TURN


def turned_command(command: FloatArray) -> FloatArray:
    """Return commands [v, w], shape (..., 2), as the robot that faces the other way needs them."""
    return command * _COMMAND_SIGNS


def turned_error(error: FloatArray) -> FloatArray:
    """Return errors [s, y, theta], shape (..., 3), seen by the robot that faces the other way."""
    return error * _ERROR_SIGNS


def turned_settings(settings: Settings) -> Settings:
    """Return the settings of the robot that faces the other way: limits are swapped, too."""
    fastest = -settings.limits.min_linear_vel
    return update(
        settings,
        {
            "min_linear_vel": -settings.limits.max_linear_vel,
            "max_linear_vel": fastest,
            "desired_speed": min(settings.target.desired_speed, fastest),
        },
    )


@dataclass(frozen=True)
class Segment:
    """A path that is driven in one go."""

    path: Path  # the path, in the direction of motion
    reverse: bool = False  # whether the robot drives along it backwards
    turn: float = 0.0  # [rad] by which it turns on the spot before, perhaps more than once round

    @property
    def turn_first(self) -> bool:
        """Return whether the robot turns on the spot to the beginning."""
        return self.turn != 0.0

    def heading_of_path(self, pose: FloatArray) -> FloatArray:
        """Return a robot's pose (3,) with the heading that it moves to: turned by pi in reverse."""
        return turned_pose(pose) if self.reverse else pose


@dataclass(frozen=True)
class Route:
    """Segments in driving order, between which the robot stops; only a single one may be closed."""

    segments: tuple[Segment, ...]
    bend_of_poses: float = math.inf  # [1/m]: the most by which the poses turn, chord by chord
    goal_heading: float | None = None  # [rad] that the robot turns to at the end, None: it does not
    goal_turn: float = 0.0  # [rad] by which it does

    @property
    def length(self) -> float:
        """Return the length of all segments [m]."""
        return sum(segment.path.length for segment in self.segments)

    @property
    def bend(self) -> float:
        """Return the highest curvature, without sign [1/m]."""
        return max(max(map(abs, segment.path.curvature_range)) for segment in self.segments)

    @property
    def closed(self) -> bool:
        """Return whether the route is one closed path."""
        return len(self.segments) == 1 and self.segments[0].path.closed

    def digest(self) -> str:
        """Return a hash: equal digests are equal routes. That of one path forwards is its own."""
        parts = [
            segment.path.digest()
            + "r" * segment.reverse
            + f"t{segment.turn:.2f}" * segment.turn_first
            for segment in self.segments
        ]
        if self.goal_heading is not None:
            parts.append(f"{self.goal_heading!r} {self.goal_turn:.2f}")
        if parts == [self.segments[0].path.digest()]:
            return parts[0]
        return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:16]

    def points(self, spacing: float = 0.05) -> FloatArray:
        """Return the robot's poses along the route, at most `spacing` [m] apart, shape (N, 3)."""
        return np.concatenate(
            [segment.heading_of_path(segment.path.points(spacing)) for segment in self.segments]
        )

    def nearest(self, pose: FloatArray) -> tuple[int, float]:
        """Return the segment and the arc length [m] on it that fit a robot's pose (3,) best."""
        found = [
            best_place(segment.path, segment.heading_of_path(pose)) for segment in self.segments
        ]
        best = min(range(len(found)), key=lambda index: float(found[index][1]))
        return best, float(found[best][0])

    def make_ready(self) -> None:
        """Compute the caches that the first control step on each segment needs."""
        for segment in self.segments:
            segment.path.make_ready()


def route_of(path: Path | Route) -> Route:
    """Return a path as the route that drives it forwards; a route as it is."""
    return path if isinstance(path, Route) else Route((Segment(path),))
