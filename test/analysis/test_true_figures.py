"""Figures of `adp analyze` for a simulated robot, against the simulation's own."""

from __future__ import annotations

import math
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.analysis.bag_analysis import analyse_bag
from adp_path_follower.core.path.curve import Path
from bag_messages import SECOND, odometry, path_message, twist_stamped, write_bag

EXAMPLES = int(os.environ.get("ADP_TRUE_FIGURES", "6"))  # bench: hundreds
STEP = 0.002  # [s] of the simulation


def loop(laps=1, gap=0.0):
    angle = np.linspace(0.0, 2.0 * math.pi * laps - gap, 80 * laps)
    return np.stack([np.sin(angle), 1.0 - np.cos(angle)], -1)


def eight():
    angle = np.linspace(0.3, 2.0 * math.pi + 0.2, 160)  # crosses itself, and ends on its start
    return np.stack([2.0 * np.sin(angle), 1.5 * np.sin(2.0 * angle)], -1)


def lanes(count=3, length=3.0, width=0.5):
    half = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 24)[1:-1]
    parts = []
    for lane in range(count):
        x = np.linspace(0.0, length, 61)
        parts.append(np.stack([x if lane % 2 == 0 else x[::-1], np.full(61, lane * width)], -1))
        side, end = (1.0, length) if lane % 2 == 0 else (-1.0, 0.0)
        turn = [end + side * 0.5 * width * np.cos(half), (lane + 0.5 + 0.5 * np.sin(half)) * width]
        parts.append(np.stack(turn, -1))
    return np.concatenate(parts[:-1])


ROUTES = {
    "laps": loop(3),
    "gap": loop(1, 0.03),
    "eight": eight(),
    "lanes": lanes(),
    "line": np.stack([np.linspace(0.0, 8.0, 81), np.zeros(81)], -1),
}


@dataclass(frozen=True)
class Truth:
    """A simulated drive: poses at the rate of the odometry, and what is true of it."""

    time: np.ndarray
    poses: np.ndarray
    speed: np.ndarray
    distance: float
    covered: float
    cross_track: np.ndarray


def arc(start, turn, radius, backwards=False, step=0.05):
    """Return poses on an arc from a pose by an angle [rad], left if positive, (N, 3)."""
    angle = np.linspace(0.0, turn, max(8, round(radius * abs(turn) / step)))
    sign = -1.0 if backwards else 1.0
    left = math.copysign(radius, turn) * sign
    x, y, heading = start
    here = heading + angle
    return np.column_stack(
        [
            x + left * (np.sin(here) - math.sin(heading)),
            y - left * (np.cos(here) - math.cos(heading)),
            here,
        ]
    )


def straight(start, length, step=0.05):
    """Return poses on a line from a pose, backwards if the length [m] is negative, (N, 3)."""
    along = np.linspace(0.0, length, max(8, round(abs(length) / step)))
    x, y, heading = start
    ahead = np.outer(along, [math.cos(heading), math.sin(heading)])
    return np.column_stack([np.add(ahead, [x, y]), np.full(len(along), heading)])


def three_point_turn():
    first = arc((0.0, 0.0, 0.3), 1.2, 1.2)
    second = arc(first[-1], 1.0, 1.0, backwards=True)
    return [(first, False), (second, True), (straight(second[-1], 2.0), False)]


def parking():
    first = straight((1.0, -2.0, -0.7), 3.0)
    second = arc(first[-1], -1.3, 1.0, backwards=True)
    return [(first, False), (second, True), (straight(second[-1], -1.0), True)]


def there_and_back():
    first = straight((0.0, 0.0, 2.0), 2.5)
    return [(first, False), (straight(first[-1], -2.5), True)]


REVERSALS = {"turn": three_point_turn(), "parking": parking(), "back": there_and_back()}


def shuttled(parts, speed: float, rate: float, swing: float) -> Truth:
    """Return a robot that swings about paths one after the other, forwards or in reverse."""
    poses, velocity, lateral = [], [], []
    for points, backwards in parts:
        path = Path.from_points(points[:, :2], closed=False)
        place = np.arange(0.0, path.length, speed * STEP)
        waves = 2.0 * math.pi * max(1, round(path.length / math.pi)) / path.length
        frame, aside = path.frame(place), swing * np.sin(waves * place)
        x, y, tangent = frame.pose.T
        slope = np.arctan2(waves * swing * np.cos(waves * place), 1.0 - frame.curvature * aside) + (
            math.pi if backwards else 0.0
        )
        heading = np.unwrap(tangent) + slope
        moved = np.column_stack([x - aside * np.sin(tangent), y + aside * np.cos(tangent), heading])
        poses.append(moved)
        steps = np.hypot(*np.diff(moved[:, :2], axis=0, append=moved[-1:, :2]).T)
        velocity.append((-steps if backwards else steps) / STEP)
        lateral.append(np.abs(aside))
    all_poses, all_lateral = np.concatenate(poses), np.concatenate(lateral)
    rows = np.arange(0, len(all_poses), max(1, round(1.0 / (rate * STEP))))
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(all_poses[:, :2], axis=0).T))])
    covered = speed * STEP * rows[-1]
    return Truth(
        STEP * rows, all_poses[rows], np.concatenate(velocity)[rows], float(driven[rows[-1]]),
        float(covered), all_lateral[rows],
    )  # fmt: skip


def simulated(points, speed: float, rate: float, swing: float, backwards: bool) -> Truth:
    """Return a robot that swings about a path, along it, and back for the last metre if asked."""
    path = Path.from_points(points, closed=False)
    there = path.length - 0.05
    duration = there / speed
    time = np.arange(0.0, duration, STEP)
    place = speed * time
    if backwards:
        place = np.concatenate([place, place[-1] - speed * np.arange(0.0, 0.5 / speed, STEP)])
        time = STEP * np.arange(len(place))
    frame = path.frame(place)
    lateral = swing * np.sin(2.0 * place)
    x, y, tangent = frame.pose.T
    x, y = x - lateral * np.sin(tangent), y + lateral * np.cos(tangent)
    heading = np.unwrap(tangent) + np.arctan2(
        2.0 * swing * np.cos(2.0 * place), 1.0 - frame.curvature * lateral
    )
    steps = np.hypot(np.diff(x), np.diff(y))
    sign = np.where(np.diff(place) < 0.0, -1.0, 1.0)
    velocity = np.append(sign * steps / STEP, 0.0)
    velocity[-1] = velocity[-2]
    every = max(1, round(1.0 / (rate * STEP)))
    rows = np.arange(0, len(time), every)
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    poses = np.column_stack([x, y, heading])[rows]
    return Truth(
        time[rows], poses, velocity[rows], float(driven[rows[-1]]),
        float(place[rows[-1]] - place[0]), np.abs(lateral[rows]),
    )  # fmt: skip


def bag_of(truth: Truth, points, noise: float, jump: float, seed: int):
    """Return the messages of a drive whose odometry is noisy, and jumps aside for a while."""
    poses = truth.poses.copy()
    poses[:, :2] += np.random.default_rng(seed).normal(0.0, noise, (len(poses), 2))
    middle = slice(len(poses) // 2, 2 * len(poses) // 3)
    poses[middle, :2] += jump
    messages = [("/path", 0, path_message(points.tolist()))]
    for time, pose, speed in zip(truth.time, poses.tolist(), truth.speed.tolist(), strict=True):
        stamp = SECOND + round(time * SECOND)
        messages.append(("/odom", stamp, odometry(stamp, *pose, speed)))
        messages.append(("/cmd_vel", stamp + 1_000_000, twist_stamped(stamp, speed, 0.1)))
    return messages


def figures(messages) -> dict[str, float]:
    with tempfile.TemporaryDirectory() as folder:
        return dict(analyse_bag(write_bag(FilePath(folder) / "bag", messages), {}, 1, None).metrics)


def check_figures(found, truth, noise):
    """Compare time, ways and distance from the path with the simulator's."""
    slack = 0.001 + 6.0 * noise  # of the ends of a noisy drive
    assert found["duration"] == pytest.approx(truth.time[-1], abs=1e-6)
    assert found["distance"] == pytest.approx(truth.distance, rel=0.01, abs=slack)
    assert found["path_covered"] == pytest.approx(truth.covered, rel=0.01, abs=slack)
    rms = math.sqrt(float(np.mean(truth.cross_track**2)) + noise**2)
    assert found["cross_track_rms"] == pytest.approx(rms, rel=0.01, abs=0.001)


@settings(max_examples=EXAMPLES)
@given(
    route=st.sampled_from(sorted(ROUTES)),
    speed=st.floats(0.2, 0.6),
    rate=st.sampled_from([2.0, 5.0, 20.0, 50.0]),
    swing=st.sampled_from([0.0, 0.03]),
    noise=st.sampled_from([0.0, 0.002]),
    backwards=st.booleans(),
    seed=st.integers(0, 99),
)
def test_figures_are_those_of_the_simulation(route, speed, rate, swing, noise, backwards, seed):
    points = ROUTES[route]
    truth = simulated(points, speed, rate, swing, backwards)
    found = figures(bag_of(truth, points, noise, 0.0, seed))
    check_figures(found, truth, noise)
    assert found["cross_track_max"] == pytest.approx(
        float(truth.cross_track.max()), rel=0.01, abs=0.001 + 5.0 * noise
    )


@settings(max_examples=EXAMPLES)
@given(
    route=st.sampled_from(sorted(REVERSALS)),
    speed=st.floats(0.2, 0.6),
    rate=st.sampled_from([2.0, 5.0, 20.0, 50.0]),
    swing=st.sampled_from([0.0, 0.02]),
    noise=st.sampled_from([0.0, 0.002]),
    oriented=st.booleans(),
    seed=st.integers(0, 99),
)
def test_figures_of_a_robot_that_reverses(route, speed, rate, swing, noise, oriented, seed):
    """By the orientations of the path, or its cusps alone."""
    parts = REVERSALS[route]
    truth = shuttled(parts, speed, rate, swing)
    points = np.concatenate([part for part, _ in parts])
    points[:, 2] *= oriented
    found = figures(bag_of(truth, points, noise, 0.0, seed))
    check_figures(found, truth, noise)
    assert found["heading_max"] < 0.2


@settings(max_examples=max(2, EXAMPLES // 3))
@given(rate=st.sampled_from([10.0, 50.0]), jump=st.sampled_from([0.3, 1.5]), seed=st.integers(0, 9))
def test_jumps_of_the_odometry_are_no_way(rate, jump, seed):
    truth = simulated(ROUTES["line"], 0.5, rate, 0.0, False)
    found = figures(bag_of(truth, ROUTES["line"], 0.0, jump, seed))
    lost = 2.0 * 0.5 / rate  # the steps in which it jumps
    assert found["distance"] == pytest.approx(truth.distance, rel=0.01, abs=0.001 + lost)
    assert found["path_covered"] == pytest.approx(truth.covered, rel=0.01, abs=0.001 + lost)
