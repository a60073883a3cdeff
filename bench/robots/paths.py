"""Paths to drive robots on."""

from __future__ import annotations

import math

import numpy as np

from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import lissajous, path_through


def bend() -> Path:
    """Return 14 m of the paper's figure eight round its sharpest bend."""
    whole = lissajous()
    places = np.linspace(0.0, whole.length, 20001)
    sharpest = places[np.argmax(np.abs(whole.curvature(places)))]
    around = sharpest + np.linspace(-6.0, 8.0, 701)
    return Path.from_points(whole.frame(around).pose[:, :2], closed=False)


def slalom() -> Path:
    """Return a slalom with an amplitude of 0.5 m and a period of 4 m."""
    x = np.linspace(0.0, 24.0, 1201)
    return Path.from_points(
        np.column_stack([x, 0.25 * (1 - np.cos(0.5 * math.pi * x)) * 2 - 0.5]), closed=False
    )


def corners() -> Path:
    """Return a route of right-angled corners."""
    points = [[0, 0], [3, 0], [3, 2], [5, 2], [5, 0], [8, 0], [8, 3], [4, 3.5], [4, 5]]
    return path_through(np.array(points, float), False)


def race_track() -> Path:
    """Return a closed course of bends and straights."""
    p = np.linspace(0.0, 2.0 * math.pi, 801)[:-1]
    radius = 3.0 + 0.9 * np.sin(2 * p + 0.4) + 0.6 * np.cos(3 * p)
    return Path.from_points(
        np.column_stack([1.4 * radius * np.cos(p), radius * np.sin(p)]), closed=True
    )


PATHS = {"bend": bend, "slalom": slalom, "corners": corners, "race_track": race_track}
