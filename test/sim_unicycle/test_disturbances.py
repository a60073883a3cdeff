"""Drive, ground and odometry of the simulated robot against closed forms and other methods."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from adp_path_follower.core.path.library import circle
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.simulation.simulate import simulate
from sim_unicycle.settings import PlantSettings
from sim_unicycle.unicycle import Unicycle


def driven(plant, command, dt, steps, pose=(0.0, 0.0, 0.0)):
    """Return a robot after some steps with one command, and its twists."""
    robot, twists = Unicycle(np.array(pose), plant), []
    for _ in range(steps):
        robot.step(np.array(command), dt)
        twists.append(robot.twist)
    return robot, np.array(twists)


@settings(max_examples=60)
@given(
    speed=st.floats(-2.0, 2.0),
    limit=st.floats(0.1, 5.0),
    lag=st.sampled_from([0.0, 0.05, 0.5]),
    steps=st.lists(st.floats(0.01, 0.7), min_size=1, max_size=6),
)
def test_limited_acceleration_is_the_solution_of_its_differential_equation(
    speed, limit, lag, steps
):
    robot = Unicycle(np.zeros(3), PlantSettings(max_linear_accel=limit, velocity_lag=lag))
    for dt in steps:
        robot.step(np.array([speed, 0.0]), dt)
    # Tiny explicit steps, which know nothing of ramps and exponentials.
    count = 20_000
    dt = sum(steps) / count
    velocity, distance = 0.0, 0.0
    for _ in range(count):
        gap = speed - velocity
        rate = gap / max(lag, dt)
        velocity += dt * min(max(rate, -limit), limit)
        distance += dt * velocity
    assert robot.pose[0] == pytest.approx(distance, abs=2e-3)


def test_a_ramp_ends_where_it_should_within_a_step():
    # From 0 to 1 m/s at 2 m/s^2 takes 0.5 s and 0.25 m; the rest of the second is 0.5 m.
    robot, _ = driven(PlantSettings(max_linear_accel=2.0), [1.0, 0.0], 1.0, 1)
    assert robot.pose[0] == pytest.approx(0.75, abs=1e-12)
    # Turning has a limit of its own, and none unless it is set.
    assert robot.twist[1] == 0.0
    robot, _ = driven(PlantSettings(max_linear_accel=2.0), [1.0, 0.7], 1.0, 1)
    assert robot.twist[1] == 0.7
    robot, _ = driven(PlantSettings(max_angular_accel=2.0), [1.0, 1.0], 1.0, 1)
    assert robot.twist.tolist() == pytest.approx([1.0, 0.75])


@settings(max_examples=40)
@given(
    command=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)),
    linear=st.floats(0.0, 1.0),
    angular=st.floats(0.0, 1.0),
)
def test_slip_scales_the_motion_and_odometry_reports_the_wheels(command, linear, angular):
    plant = PlantSettings(linear_slip=linear, angular_slip=angular)
    robot, twists = driven(plant, command, 0.1, 5)
    expected = [command[0] * (1.0 - linear), command[1] * (1.0 - angular)]
    np.testing.assert_allclose(twists, np.tile(expected, (5, 1)), atol=1e-12)
    ideal, _ = driven(PlantSettings(), expected, 0.1, 5)
    np.testing.assert_allclose(robot.pose, ideal.pose, atol=1e-9)
    assert robot.arrived[0].twist.tolist() == list(command)


def test_friction_bounds_braking_and_bends():
    plant = PlantSettings(friction=0.1)
    slowest = 0.1 * 9.81
    robot, twists = driven(plant, [1.0, 3.0], 0.05, 100)
    assert np.diff(twists[:, 0], prepend=0.0).max() <= slowest * 0.05 + 1e-12
    assert np.abs(twists[:, 0] * twists[:, 1]).max() <= slowest + 1e-12
    assert twists[-1] == pytest.approx([1.0, slowest])
    # It comes to rest after v^2 / (2 a).
    place = robot.pose.copy()
    robot.step(np.zeros(2), 2.0)
    turned = robot.pose[2] - place[2]
    assert turned == 0.0
    assert np.hypot(*(robot.pose - place)[:2]) == pytest.approx(0.5 / slowest, rel=1e-9)


@settings(max_examples=40)
@given(
    heading=st.floats(-3.0, 3.0),
    command=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    push=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
)
def test_a_push_is_a_velocity_beside_that_of_the_wheels(heading, command, push):
    robot, _ = driven(PlantSettings(push=push), command, 0.5, 4, (1.0, 2.0, heading))
    # The exponential map of SE(2): a third method.
    from scipy.linalg import expm

    v, w = command[0] + push[0], command[1] + push[2]
    twist = 2.0 * np.array([[0.0, -w, v], [w, 0.0, push[1]], [0.0, 0.0, 0.0]])
    cos, sin = math.cos(heading), math.sin(heading)
    place = np.array([[cos, -sin, 1.0], [sin, cos, 2.0], [0.0, 0.0, 1.0]]) @ expm(twist)
    np.testing.assert_allclose(robot.pose[:2], place[:2, 2], atol=1e-9)
    assert robot.pose[2] == pytest.approx(heading + 2.0 * w)
    assert robot.arrived[0].twist.tolist() == list(command)


@pytest.mark.parametrize("dt", [0.01, 0.25])
def test_drift_is_a_random_walk(dt):
    plant = PlantSettings(position_drift=0.1, heading_drift=0.02, seed=3)
    robot = Unicycle(np.zeros((4000, 3)), plant)
    rates = np.array([0.1, 0.1, 0.02])
    offsets = []
    for _ in range(2):
        for _ in range(round(1.0 / dt)):
            robot.step(np.zeros((4000, 2)), dt)
        offsets.append(robot.measured_pose() / rates)
    # Variance t after t seconds; four standard errors of it, sqrt(2 / n) each.
    for time, offset in enumerate(offsets, start=1):
        np.testing.assert_allclose(offset.var(axis=0), time, rtol=4.0 * math.sqrt(2.0 / 4000))
    # Independent increments.
    increments = offsets[1] - offsets[0]
    assert np.abs(np.corrcoef(increments.T, offsets[0].T) - np.eye(6)).max() < 0.065
    assert (robot.pose == 0.0).all()


@settings(max_examples=30)
@given(periods=st.integers(0, 7), longer=st.floats(0.0, 0.9))
def test_delayed_odometry_is_what_was_measured_then(periods, longer):
    dt = 0.02
    # In whole steps, rounded up.
    delay = dt * (periods - longer) if periods else 0.0
    robot = Unicycle(np.zeros(3), PlantSettings(odometry_delay=delay))
    poses, times = [robot.pose], [0.0]
    for step in range(1, 15):
        robot.step(np.array([1.0, 0.5]), dt)
        poses.append(robot.pose)
        times.append(robot.time)
        then = max(0, step - periods)
        np.testing.assert_allclose(robot.measured_pose(), poses[then], atol=1e-12)
        if step >= periods:
            # The first one has arrived at the start, and does not come again.
            assert [r.time for r in robot.arrived] == ([times[then]] if then else [])
        else:
            assert robot.arrived == ()


@pytest.mark.parametrize("share", [0.1, 0.7])
def test_the_share_of_lost_odometry_is_the_probability(share):
    robot = Unicycle(np.zeros(3), PlantSettings(odometry_drop=share, seed=11))
    lost = 0
    for _ in range(4000):
        before = robot.measured_pose()
        robot.step(np.array([1.0, 0.0]), 0.01)
        if not robot.arrived:
            lost += 1
            assert robot.measured_pose().tolist() == before.tolist()
        else:
            assert robot.measured_pose().tolist() == robot.pose.tolist()
    low, high = binom.ppf([1e-4, 1.0 - 1e-4], 4000, share)
    assert low <= lost <= high


def readings(poses, plant, run=0, steps=20):
    """Return what is measured of robots that drive, shape (steps, ..., 3)."""
    robot = Unicycle(poses, plant, run)
    found = []
    for _ in range(steps):
        robot.step(np.broadcast_to([1.0, 0.5], (*np.shape(poses)[:-1], 2)), 0.01)
        found.append(robot.measured_pose())
    return np.array(found)


NOISY = {"position_noise": 0.1, "heading_noise": 0.1, "seed": 40}


def test_a_run_of_a_batch_sees_what_it_sees_alone():
    others = {"position_drift": 0.2, "odometry_drop": 0.3, "odometry_delay": 0.02}
    plant = PlantSettings(**NOISY, **others)
    together = readings(np.zeros((5, 3)), plant, run=2)
    for index in range(5):
        alone = readings(np.zeros(3), plant, run=2 + index)
        np.testing.assert_allclose(together[:, index], alone, atol=1e-13)
    reseeded = PlantSettings(**{**NOISY, "seed": 43}, **others)
    np.testing.assert_allclose(together[:, 1], readings(np.zeros(3), reseeded), atol=1e-13)
    assert np.abs(together[:, 0] - together[:, 1]).max() > 0.05


def test_one_disturbance_does_not_change_the_numbers_of_another():
    noise = readings(np.zeros(3), PlantSettings(**NOISY))
    both = readings(np.zeros(3), PlantSettings(**NOISY, position_drift=0.5))
    drift = readings(np.zeros(3), PlantSettings(position_drift=0.5, seed=40))
    ideal = readings(np.zeros(3), PlantSettings())
    np.testing.assert_allclose(both - drift, noise - ideal, atol=1e-12)


def test_a_shorter_delay_takes_the_newest_command():
    robot = Unicycle(np.zeros(3), PlantSettings(command_delay=0.1))
    robot.step(np.array([1.0, 0.0]), 0.02)
    robot.plant = PlantSettings()
    robot.step(np.array([0.3, 0.0]), 0.02)
    assert robot.twist.tolist() == [0.3, 0.0]
    robot.plant = PlantSettings(command_delay=0.02)
    robot.step(np.array([0.7, 0.0]), 0.02)
    assert robot.twist.tolist() == [0.3, 0.0]
    robot.step(np.array([0.7, 0.0]), 0.02)
    assert robot.twist.tolist() == [0.7, 0.0]


class Recorded:
    """A controller that stands, and notes what it measures."""

    measured: dict[float, np.ndarray]

    def __init__(self, settings, path, arc_length):
        from steady import steady_target

        self.settings, self.path, self.measured, self.time = settings, path, {}, 0.0
        self.target = steady_target(path, settings.target, arc_length)

    def step(self, pose, dt):
        """Return a zero command."""
        from adp_path_follower.core.driving.output import ControlOutput

        self.measured[round(self.time, 6)] = pose
        self.time += dt
        frame, error = self.target.move(pose, dt)
        none = np.zeros((len(pose), 2))
        place = self.target.arc_length
        return ControlOutput(none, none, error, frame.pose, place, frame.curvature)


def test_controllers_of_any_rate_see_the_same_noise():
    seen = []
    for rate in (100.0, 20.0):
        made = []

        def factory(*arguments, made=made):
            made.append(Recorded(*arguments))
            return made[0]

        simulate(
            build(Settings, {"robot_model": "ideal"}),
            circle(1.0),
            np.zeros((3, 3)),
            duration=1.0,
            rate=rate,
            plant=PlantSettings(**NOISY, odometry_drop=0.2),
            controller=factory,
        )
        seen.append(made[0].measured)
    assert len(seen[1]) == 21
    for time, pose in seen[1].items():
        np.testing.assert_array_equal(pose, seen[0][time])
