"""Routes of which one pose does not tell the place, and inputs from the field."""

from __future__ import annotations

import functools
import math

import numpy as np

from adp_path_follower.core.path.library import read_poses
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.settings.groups import PathSettings
from folders import CASES

OPEN = PathSettings(path_closed="open")


def case(name, settings=None):
    """Return the route of an input from the field."""
    poses, closed = read_poses(CASES / name)
    return prepare(poses[:, :2], settings or PathSettings(), poses[:, 2], closed)


def laps(count, radius, noise, random):
    angle = np.linspace(0.0, math.tau * count, math.ceil(40 * count))
    points = radius * np.stack([np.sin(angle), 1.0 - np.cos(angle)], axis=1)
    return points + noise * random.standard_normal(points.shape)


def loop(gap, radius):
    angle = np.linspace(0.0, math.tau - gap / radius, 90)
    return radius * np.stack([np.sin(angle), 1.0 - np.cos(angle)], axis=1)


def lanes(count, spacing, length):
    corners = []
    for lane in range(count):
        ends = [(0.0, lane * spacing), (length, lane * spacing)]
        corners += ends[:: 1 if lane % 2 == 0 else -1]
    return np.array(corners)


def eights(count, size):
    angle = np.linspace(0.0, math.tau * count, 80 * count)
    return size * np.stack([np.sin(angle), np.sin(2.0 * angle)], axis=1)


@functools.cache
def random_route(seed):
    """Return a route of laps, lanes, crossings, or a loop with a gap, somewhere on the plane."""
    random = np.random.default_rng(seed)
    kind = seed % 4
    if kind == 0:
        noise = random.uniform(0.0, 0.005)
        points = laps(random.choice([1.3, 2.0, 3.0]), random.uniform(0.5, 2.0), noise, random)
    elif kind == 1:
        points = loop(random.uniform(0.0, 0.3), random.uniform(0.8, 4.0))
    elif kind == 2:
        points = lanes(random.integers(2, 6), random.uniform(0.4, 1.5), random.uniform(2.0, 6.0))
    else:
        points = eights(random.integers(1, 3), random.uniform(1.0, 4.0))
    turn = random.uniform(-math.pi, math.pi)
    turned = points @ np.array(
        [[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]]
    )
    return prepare(turned + random.uniform(-50.0, 50.0, 2), OPEN)
