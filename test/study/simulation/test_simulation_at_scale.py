"""Many runs at once against the same runs one at a time."""

import tracemalloc

import numpy as np
import pytest

from adp_path_follower.core.driving.follower import PathFollower
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import advance_pose, pose_in_frame
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import update
from adp_path_follower.resources import config_file
from adp_path_follower.study.simulation.simulate import simulate
from sim_unicycle.settings import PlantSettings

# Near and far, ahead and behind, forwards, sideways and backwards.
STARTS = np.array(
    [
        [-0.5, 0.25, -0.5236],
        [0.9, -0.8, 1.0],
        [3.0, 2.0, 2.8],
        [-4.0, 1.0, -3.0],
        [0.0, 0.0, 0.0],
        [0.2, 6.0, 0.1],
    ]
)
MOTION = {  # limits, a speed profile and an actuation delay
    "min_linear_vel": 0.0,
    "max_linear_vel": 0.8,
    "max_angular_vel": 1.2,
    "max_linear_accel": 0.5,
    "max_linear_decel": 0.7,
    "max_angular_accel": 2.0,
    "max_linear_jerk": 5.0,
    "max_lateral_accel": 0.1,
    "actuation_delay": 0.05,
}
LIMITS = {"min_linear_vel": 0.0, "max_linear_vel": 1.0, "max_angular_vel": 1.5}
PLACE = 12.0  # [m] along the path: bends come
NAMES = ("pose", "error", "arc_length", "command", "critic_weights", "actor_weights")
SMALL = {"basis_degree": 3, "sample_count": 64, "samples_per_step": 32}


def tuning(file, changes):
    return update(load_settings(Settings, "path_follower", config_file(f"{file}.yaml")), changes)


def assert_equal_runs(together, index, single):
    for name in (*NAMES, "bellman_error"):
        found = getattr(together.trajectories, name)[index]
        expected = getattr(single.trajectories, name)[0]
        scale = max(1.0, float(np.abs(expected).max()))
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9 * scale)
    for name in ("cost", "effort", "final_error", "settling_time", "max_inputs", "excitation"):
        found, expected = getattr(together, name)[index], getattr(single, name)[0]
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("changes", [{}, LIMITS, MOTION], ids=["plain", "limits", "motion"])
@pytest.mark.parametrize("learning", ["cold", "frozen"])
@pytest.mark.parametrize("file", ["default", "paper"])
def test_many_at_once_are_the_runs_one_at_a_time(figure_eight, file, learning, changes):
    settings = tuning(file, changes)
    options = {"duration": 0.8, "learning": learning, "start_arc_length": PLACE, "record": True}
    together = simulate(settings, figure_eight, STARTS, **options)
    for index, start in enumerate(STARTS):
        single = simulate(settings, figure_eight, start, **options)
        assert_equal_runs(together, index, single)
    assert not together.failed.any()


@pytest.mark.parametrize("changes", [{}, MOTION], ids=["plain", "motion"])
@pytest.mark.parametrize(
    ("file", "learning"), [("default", True), ("default", False), ("paper", True)]
)
def test_many_at_once_are_what_one_follower_does_in_a_loop(figure_eight, file, learning, changes):
    settings = tuning(file, {**changes, "learning": learning})
    mode = "cold" if learning else "frozen"
    options = {"duration": 1.2, "learning": mode, "start_arc_length": PLACE, "record": True}
    record = simulate(settings, figure_eight, STARTS[:4], **options).trajectories
    for index, start in enumerate(STARTS[:4]):
        follower = PathFollower(settings, figure_eight, PLACE)
        pose = pose_in_frame(start, figure_eight.frame(PLACE).pose)
        for step in range(121):
            output = follower.step(pose, 0.01)
            np.testing.assert_allclose(record.command[index, step], output.command, atol=1e-9)
            np.testing.assert_allclose(record.error[index, step], output.error, atol=1e-9)
            weights = output.weights.actor
            found = record.actor_weights[index, step]
            np.testing.assert_allclose(found, weights, atol=1e-9 * max(1.0, np.abs(weights).max()))
            pose = advance_pose(pose, *output.command, 0.01)


@pytest.mark.parametrize("file", ["default", "paper"])
@pytest.mark.parametrize("at_once", [1, 4, 7])
def test_the_size_of_the_blocks_does_not_matter(figure_eight, file, at_once):
    settings = tuning(file, SMALL)
    plant = PlantSettings(position_noise=0.01, heading_noise=0.01, odometry_drop=0.2, seed=5)
    options = {"duration": 0.5, "start_arc_length": PLACE, "record": True, "plant": plant}
    whole = simulate(settings, figure_eight, STARTS, **options)
    blocks = simulate(settings, figure_eight, STARTS, at_once=at_once, **options)
    np.testing.assert_array_equal(blocks.starts, STARTS)
    for name in ("cost", "effort", "final_error", "settling_time", "max_inputs", "excitation"):
        found, expected = getattr(blocks, name), getattr(whole, name)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    for name in NAMES:
        found, expected = getattr(blocks.trajectories, name), getattr(whole.trajectories, name)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    for index in (0, 5):  # each run has noise of its own
        own = {**options, "plant": PlantSettings(**{**vars(plant), "seed": 5 + index})}
        single = simulate(settings, figure_eight, STARTS[index], **own)
        np.testing.assert_allclose(single.cost[0], whole.cost[index], rtol=1e-9)


def peak_memory(settings, path, runs, **options):
    """Return the most memory [bytes] that a simulation takes."""
    starts = np.random.default_rng(0).uniform(-0.5, 0.5, (runs, 3))
    tracemalloc.start()
    try:
        simulate(settings, path, starts, duration=0.1, rate=50.0, **options)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("file", ["default", "paper"])
def test_memory_is_bounded_by_the_block_and_grows_in_proportion_to_it(file):
    settings, path = tuning(file, SMALL), named_path("circle:0.5")
    few = peak_memory(settings, path, 32, at_once=32)
    many = peak_memory(settings, path, 128, at_once=32)
    assert many < few + 96 * 2000  # bytes: what is kept of a run is its outcome
    blocks = [peak_memory(settings, path, runs, at_once=runs) for runs in (128, 256, 512)]
    slopes = np.diff(blocks) / [128.0, 256.0]
    assert slopes[1] < 1.2 * slopes[0]


def test_blocks_are_smaller_where_a_run_has_more_weights(figure_eight, monkeypatch):
    counts = []

    def follower(settings, path, arc_length):
        counts.append(len(arc_length))
        return PathFollower(settings, path, arc_length)

    starts = np.zeros((60, 3))
    options = {"duration": 0.02, "controller": follower}
    monkeypatch.setattr("adp_path_follower.study.simulation.simulate._MOST_BYTES", 200_000)
    simulate(tuning("default", SMALL), figure_eight, starts, **options)
    assert len(counts) > 1
    assert sum(counts) == 60
    counts.clear()
    simulate(tuning("default", SMALL), figure_eight, starts, learning="frozen", **options)
    simulate(tuning("paper", {}), figure_eight, starts, **options)
    assert counts == [60, 60]  # there all runs have one set, or each has few


@pytest.mark.parametrize("at_once", [0, -3])
def test_a_block_of_no_runs_is_refused(figure_eight, at_once):
    with pytest.raises(AdpError, match=f"at_once is {at_once} runs"):
        simulate(tuning("paper", {}), figure_eight, STARTS, duration=0.1, at_once=at_once)
