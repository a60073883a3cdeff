"""The places of a drive: laps, gaps, lanes, crossings and jumps."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.drive import project
from adp_path_follower.core.path.library import circle


def loop(gap=0.0, laps=1):
    """Return an open path round a circle of 1 m, so many laps less a gap [m] at the end."""
    angle = np.linspace(0.0, 2.0 * math.pi * laps - gap, 60 * laps)
    return Path.from_points(np.stack([np.sin(angle), 1.0 - np.cos(angle)], -1), closed=False)


def lawnmower(lanes=4, length=4.0, width=0.5):
    """Return lanes there and back, joined by half circles."""
    half = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 16)
    points = []
    for lane in range(lanes):
        ends = np.linspace(0.0, length, 40)
        x = ends if lane % 2 == 0 else ends[::-1]
        points.append(np.stack([x, np.full(40, lane * width)], -1))
        side, middle = (1.0, length) if lane % 2 == 0 else (-1.0, 0.0)
        arc = [
            middle + side * 0.5 * width * np.cos(half),
            (lane + 0.5) * width + 0.5 * width * np.sin(half),
        ]
        points.append(np.stack(arc, -1)[1:-1])
    return Path.from_points(np.concatenate(points[:-1]), closed=False)


PATHS = {"loop": loop(), "gap": loop(0.03), "laps": loop(laps=3), "lanes": lawnmower()}


def driven(path, places, noise, seed):
    """Return poses of a robot at arc lengths (N,), with noise [m] of the position."""
    poses = path.frame(places).pose.copy()
    poses[:, :2] += np.random.default_rng(seed).normal(0.0, noise, (len(places), 2))
    return poses


@settings(max_examples=25)
@given(
    name=st.sampled_from(sorted(PATHS)),
    spacing=st.floats(0.005, 0.3),
    noise=st.floats(0.0, 0.01),
    seed=st.integers(0, 99),
)
def test_a_drive_from_start_to_end_has_its_own_places(name, spacing, noise, seed):
    path = PATHS[name]
    places = np.arange(0.0, path.length, spacing)
    found = project(path, driven(path, places, noise, seed))
    assert np.abs(found.arc_length - places).max() < 0.01 + 6.0 * noise
    assert np.sqrt(np.mean(found.cross_track**2)) <= 1.5 * noise + 1e-9


def test_a_drive_that_begins_later_keeps_the_earliest_lap():
    path = PATHS["laps"]
    places = np.arange(1.0, 4.0, 0.05)
    assert project(path, driven(path, places, 0.0, 0)).arc_length == pytest.approx(places, abs=1e-8)


def test_at_a_crossing_the_way_that_is_driven_decides(figure_eight):
    places = np.arange(0.0, 20.0, 0.02)
    poses = figure_eight.frame(places).pose.copy()
    poses[:30, 2] += 0.4  # where the robot starts, it looks aside
    assert project(figure_eight, poses).arc_length == pytest.approx(places, abs=1e-8)


def test_few_poses_of_a_fast_robot_lose_no_lap():
    path = circle(0.2)  # 31.4 m round
    places = np.arange(0.0, 4.0 * path.length, 1.6)  # 8 m/s at 5 Hz
    assert project(path, path.frame(places).pose).arc_length == pytest.approx(places, abs=1e-6)


def test_after_a_jump_of_the_odometry_the_drive_comes_back_to_its_path():
    path = Path.from_points([[0.0, 0.0], [60.0, 0.0]])
    places = np.arange(0.0, 40.0, 0.02)
    poses = path.frame(places).pose.copy()
    beside = np.where(places < 10.0, 0.0, 3.0 * np.exp(-(places - 10.0)))  # 3 m, driven away
    poses[:, 1] += beside
    found = project(path, poses)
    assert found.cross_track == pytest.approx(beside, abs=1e-6)
    assert found.arc_length == pytest.approx(places, abs=1e-6)


def test_beyond_an_end_the_distance_is_to_the_end():
    path = Path.from_points([[0.0, 0.0], [4.0, 0.0]])
    poses = np.array([[-0.3, 0.4, 0.0], [1.0, -0.2, 0.0], [4.6, -0.8, 0.0]])
    found = project(path, poses)
    assert found.arc_length == pytest.approx([0.0, 1.0, 4.0], abs=1e-9)
    assert found.cross_track == pytest.approx([0.5, -0.2, -1.0], abs=1e-9)


def test_a_drive_stays_on_its_branch_over_the_laps(figure_eight):
    places = np.arange(0.5, 2.2 * figure_eight.length, 0.03)
    drive = project(figure_eight, figure_eight.frame(places).pose)
    laps = np.round((drive.arc_length - places)[0] / figure_eight.length)
    assert drive.arc_length == pytest.approx(places + laps * figure_eight.length, abs=1e-8)


def test_a_robot_that_was_put_elsewhere_is_searched_on_the_whole_path(figure_eight):
    places = np.concatenate([np.arange(1.0, 3.0, 0.02), np.arange(30.0, 32.0, 0.02)])
    found = project(figure_eight, figure_eight.frame(places).pose)
    assert found.arc_length == pytest.approx(places, abs=1e-8)


def test_a_drive_without_poses_has_no_places(figure_eight):
    found = project(figure_eight, np.zeros((0, 3)))
    assert len(found.arc_length) == len(found.cross_track) == len(found.heading) == 0
