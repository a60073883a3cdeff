"""A robot with noise, delay, lag and slip: the settings for it beside the peers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.path.drive import project
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.comparison.controllers import PEERS
from adp_path_follower.study.simulation.simulate import simulate
from folders import CONFIG
from sim_unicycle.settings import PlantSettings

FILE = CONFIG / "late_robot.yaml"
PATH = named_path("lissajous")
LATE = {
    "command_delay": 0.05,
    "velocity_lag": 0.1,
    "linear_slip": 0.05,
    "angular_slip": 0.05,
}
NOISE = {"position_noise": 0.01, "heading_noise": math.radians(1.0)}
BEST_PEERS = ("lapierre_soetanto", "stanley", "lqr")  # docs/tuning.md has the numbers of all


def distances(settings, plant, factory=PathFollower, duration=25.0):
    """Return the distances from the path after ten seconds, through the first sharp bend."""
    result = simulate(
        settings,
        PATH,
        (0.0, 0.0, 0.0),
        duration=duration,
        start_arc_length=7.5,
        plant=PlantSettings(**plant),
        controller=factory,
        record=True,
    )
    run = result.trajectories
    late = run.time > 10.0
    return project(PATH, run.pose[0][late]).cross_track


def root_mean_square(values):
    return float(np.sqrt(np.mean(values**2)))


def test_no_peer_keeps_nearer_to_the_path_of_a_bad_robot():
    settings = load_settings(Settings, "path_follower", FILE)
    plant = {**LATE, **NOISE}
    own = root_mean_square(distances(settings, plant))
    best = min(
        root_mean_square(distances(build(Settings, {}), plant, PEERS[name].factory))
        for name in BEST_PEERS
    )
    assert 0.0005 < own <= best


@pytest.mark.parametrize("curvature", ["line", "circle:0.5"])
def test_a_late_robot_has_no_limit_cycle(curvature):
    """Without noise the error comes to rest, however it began."""
    settings = load_settings(Settings, "path_follower", FILE)
    result = simulate(
        settings,
        named_path(curvature),
        (-0.3, 0.3, 0.4),
        duration=30.0,
        plant=PlantSettings(**LATE),
        record=True,
    )
    error = result.trajectories.error[0]
    last = error[-500:]  # five seconds
    assert np.ptp(last, axis=0).max() < 1e-4
    assert np.abs(last).max() < 0.05  # slip leaves an offset
