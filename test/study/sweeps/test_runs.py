"""A run of a sweep is the run that `simulate` makes, measured along its true motion."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from adp_path_follower.core.geometry import tracking_error
from adp_path_follower.core.path.drive import project
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import build, update
from adp_path_follower.study.simulation.simulate import simulate
from adp_path_follower.study.sweeps.conditions import (
    Conditions,
    PathSource,
    Robot,
    RunSettings,
)
from adp_path_follower.study.sweeps.objectives import score_of_runs
from adp_path_follower.study.sweeps.runs import MEASURES, TrackingMeter, simulate_runs
from folders import CONFIG
from sim_unicycle.fault_script import FaultScript
from sim_unicycle.settings import PlantSettings

PAPER = load_settings(Settings, "path_follower", CONFIG / "paper.yaml")
STARTS = np.array([[-0.5, 0.25, -0.5], [0.3, -0.2, 0.4], [0.1, 0.4, 0.0]])
NOISY = PlantSettings(position_noise=0.01, heading_noise=0.02, command_delay=0.05)


def runs_of(settings=PAPER, plant=None, cost=None, duration=6.0, learning="cold", path=None):
    """Return the columns of runs from the starts, with the seeds 30, 31 and 32 of noise."""
    conditions = Conditions(
        settings=dataclasses.replace(settings, cost=cost or settings.cost),
        starts=STARTS,
        forty=False,
        paths=(path or PathSource("circle:0.5"),),
        robots=(Robot("mine", plant or PlantSettings(), FaultScript()),),
        noise_seeds=(10,),
        run=RunSettings(duration=duration, rate=50.0, learning=learning, start_arc_length=0.5),
    )
    return simulate_runs(conditions, settings, np.arange(3))


def alone(settings, plant, start, **options):
    return simulate(
        settings,
        named_path("circle:0.5"),
        start,
        start_arc_length=0.5,
        duration=6.0,
        rate=50.0,
        plant=plant,
        **options,
    )


def test_a_row_is_the_run_of_its_start_and_seed():
    found = runs_of(plant=NOISY)
    assert found["robot_seed"].tolist() == [30, 31, 32]
    for row, start in enumerate(STARTS):
        plant = dataclasses.replace(NOISY, seed=int(found["robot_seed"][row]))
        single = alone(PAPER, plant, start, record=True)
        assert found["cost"][row] == pytest.approx(single.cost[0], rel=1e-9)
        assert found["effort"][row] == pytest.approx(single.effort[0], rel=1e-9)
        # The distance from the path by another way: the recorded poses, searched for the nearest
        # place of the path.
        trajectory = single.trajectories
        assert trajectory is not None
        true = project(named_path("circle:0.5"), trajectory.pose[0])
        late = trajectory.time >= 2.0
        assert found["cross_track_max"][row] == pytest.approx(
            np.abs(true.cross_track[late]).max(), rel=0.05, abs=1e-4
        )
        assert found["cross_track_rms"][row] == pytest.approx(
            np.sqrt(np.mean(true.cross_track[late] ** 2)), rel=0.02
        )
    assert len({*found["cost"]}) == 3


def test_settling_is_of_the_true_motion_and_ends_below_the_limit():
    found = runs_of(build(Settings, {}), duration=8.0, learning="frozen")
    assert found["stable"].all()
    for row, start in enumerate(STARTS):
        single = simulate(
            build(Settings, {}),
            named_path("circle:0.5"),
            start,
            start_arc_length=0.5,
            duration=8.0,
            rate=50.0,
            learning="frozen",
            record=True,
        ).trajectories
        assert single is not None
        target = named_path("circle:0.5").frame(single.arc_length[0]).pose
        size = np.linalg.norm(tracking_error(single.pose[0], target), axis=1)
        last = single.time[np.flatnonzero(size >= 0.05)[-1]]
        assert last < found["settling_time"][row] <= last + 0.1


def test_costs_are_counted_with_the_cost_that_was_asked_for():
    other = update(PAPER, {"state_cost": [1.0, 5.0, 1.0], "input_cost": [2.0, 1.0]})
    own = runs_of(other)
    judged = runs_of(other, cost=PAPER.cost)
    single = alone(other, None, STARTS, record=True)
    assert own["cost"] == pytest.approx(single.cost, rel=1e-9)
    # The same motion, another price: the sum over the recorded one.
    assert judged["cross_track_rms"] == pytest.approx(own["cross_track_rms"], rel=1e-12)
    trajectory = single.trajectories
    assert trajectory is not None
    rate = (trajectory.error**2).sum(axis=2) + (trajectory.modified_input**2).sum(axis=2)
    assert judged["cost"] == pytest.approx(0.02 * rate[:, :-1].sum(axis=1), rel=0.05)
    assert (judged["cost"] < 0.9 * own["cost"]).all()
    effort = 0.02 * (trajectory.modified_input[:, :-1] ** 2).sum(axis=(1, 2))
    assert judged["effort"] == pytest.approx(effort, rel=1e-9)


def test_frozen_weights_stay_frozen():
    cold, frozen = (runs_of(learning=learning)["cost"] for learning in ("cold", "frozen"))
    single = alone(PAPER, None, STARTS, learning="frozen")
    assert frozen == pytest.approx(single.cost, rel=1e-9)
    assert (np.abs(frozen - cold) > 1e-3).all()


def test_what_leaves_the_path_is_not_stable():
    misprinted = update(PAPER, {"basis": "paper_misprinted"})
    found = runs_of(misprinted, duration=15.0)
    assert not found["stable"].any()
    assert score_of_runs(found).unstable == 3
    assert score_of_runs(found).objectives["cost"] > 50.0
    assert {*MEASURES, "optimal_cost", "settling_time"} <= set(found)


def test_what_cannot_be_made_says_why():
    path = PathSource("mine", "digest", np.array([[0.0, 0.0], [0.0, 0.0]]), None)
    found = runs_of(path=path)
    assert all("distinct points" in text for text in found["problem"])
    assert not found["stable"].any()
    assert set(found) == set(runs_of(duration=0.2))


def test_the_observer_sees_every_run_at_every_step():
    seen: list[tuple[slice, float, int]] = []
    starts = np.zeros((130, 3))
    starts[:, 1] = np.linspace(-0.1, 0.1, 130)
    poses = np.zeros((3, 130, 3))

    def observe(runs, time, pose, output):
        seen.append((runs, time, len(pose)))
        poses[round(time / 0.1), runs] = pose
        assert output.error.shape == pose.shape

    result = simulate(
        PAPER, named_path("line"), starts, duration=0.2, rate=10.0, observe=observe, record=True
    )
    assert sum(count for *_, count in seen) == 3 * 130
    assert result.trajectories is not None
    assert (poses.swapaxes(0, 1) == result.trajectories.pose).all()


@dataclasses.dataclass
class _Output:
    arc_length: np.ndarray
    target_pose: np.ndarray


def test_the_end_of_a_run_decides_whether_it_is_stable():
    """Driven by hand: to the path, away from it, backwards along it, lost, and far off at first."""
    meter = TrackingMeter(named_path("line"), 5, 10.0, 0.1)
    for step in range(101):
        time = 0.1 * step
        x = 0.5 * time
        pose = np.array(
            [
                [x, 0.3 * (time < 2.0), 0.0],
                [x, 0.0 if time < 9.0 else 0.6, 0.0],
                [50.0 - x, 0.0, math.pi],
                [x, math.nan, 0.0],
                [x, 0.8 if time < 7.0 else 0.4, 0.0],
            ]
        )
        place = np.array([x, x, 50.0 - x, x, x])
        target = named_path("line").frame(place).pose
        meter.observe(slice(0, 128), time, pose, _Output(place, target))
    found = meter.columns()
    assert found["stable"].tolist() == [True, False, False, False, True]
    assert found["cross_track_max"][:2] == pytest.approx([0.0, 0.6], abs=1e-9)
