"""Commands after limits of acceleration and jerk, step by step and over any run of wishes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.control.actuation import limited_command
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

ZERO = np.zeros(2)
RATES = st.one_of(st.floats(0.05, 10.0), st.just(math.inf))


def after(wanted, previous, dt=0.1, rate=ZERO, **values):
    tuning = build(Settings, {"min_linear_vel": -1.0, **values})
    return limited_command(
        np.asarray(wanted, float),
        np.asarray(previous, float),
        rate,
        tuning.limits,
        tuning.motion,
        dt,
    )


@pytest.mark.parametrize(
    ("wanted", "previous", "expected"),
    [
        ((1.0, 1.0), (0.0, 0.0), (0.2, 0.3)),  # away from zero: 2 m/s², 3 rad/s²
        ((0.0, -1.0), (0.8, 0.5), (0.4, 0.2)),  # braking: 4 m/s²
        ((-1.0, 0.0), (0.8, 0.1), (0.4, 0.0)),
        ((-1.0, 0.0), (0.1, 0.0), (0.0, 0.0)),  # through zero, with another limit beyond it
        ((-1.0, 0.0), (0.0, 0.0), (-0.2, 0.0)),
        ((1.0, 0.0), (-0.8, 0.0), (-0.4, 0.0)),
        ((0.35, 0.2), (0.3, 0.1), (0.35, 0.2)),  # within reach
    ],
)
def test_one_step(wanted, previous, expected):
    limits = {"max_linear_accel": 2.0, "max_linear_decel": 4.0, "max_angular_accel": 3.0}
    np.testing.assert_allclose(after(wanted, previous, **limits), expected, atol=1e-15)


def test_an_infinite_limit_is_none():
    assert after((1.0, -1.5), (0.0, 1.5), max_linear_decel=1.0).tolist() == [1.0, -1.5]


@settings(max_examples=200)
@given(
    accel=RATES,
    decel=RATES,
    turn=RATES,
    jerk=RATES,
    turn_jerk=RATES,
    wishes=st.lists(
        st.tuples(st.floats(-0.6, 0.9), st.floats(-1.5, 1.5), st.floats(1e-4, 0.5)), max_size=30
    ),
)
def test_no_run_of_wishes_breaks_a_limit(accel, decel, turn, jerk, turn_jerk, wishes):
    values = {
        "min_linear_vel": -0.6,
        "max_linear_vel": 0.9,
        "max_linear_accel": accel,
        "max_linear_decel": decel,
        "max_angular_accel": turn,
        "max_linear_jerk": jerk,
        "max_angular_jerk": turn_jerk,
    }
    previous, rate = ZERO, ZERO
    for v, w, dt in wishes:
        command = after((v, w), previous, dt, rate, **values)
        assert np.isfinite(command).all()
        assert -0.6 - 1e-12 <= command[0] <= 0.9 + 1e-12
        assert abs(command[1]) <= 1.5 + 1e-12
        change = command - previous
        faster = abs(command[0]) > abs(previous[0])
        assert abs(change[0]) <= (accel if faster else decel) * dt * (1 + 1e-9) + 1e-12
        assert command[0] * previous[0] >= 0.0  # never through zero in one step
        assert abs(change[1]) <= turn * dt * (1 + 1e-9) + 1e-12
        previous, rate = command, change / dt


@pytest.mark.parametrize("goal", [0.8, -0.5, 0.05])
def test_jerk_is_limited_and_the_command_arrives_without_passing_by(goal):
    values = {"max_linear_accel": 1.0, "max_linear_decel": 1.0, "max_linear_jerk": 4.0}
    dt, commands = 0.01, [0.0]
    rate = ZERO
    for _ in range(300):
        before = np.array([commands[-1], 0.0])
        command = after((goal, 0.0), before, dt, rate, **values)
        rate = (command - before) / dt
        commands.append(float(command[0]))
    speed = np.array(commands)
    acceleration = np.diff(speed, prepend=0.0) / dt
    assert speed[-1] == pytest.approx(goal, abs=1e-6)
    assert np.abs(speed).max() <= abs(goal) + 4.0 * dt**2 / 8.0 + 1e-9
    assert np.abs(acceleration).max() <= 1.0 + 1e-9
    assert np.abs(np.diff(acceleration)).max() / dt <= 4.0 + 1e-6
    # The closed form of an S-curve: v / a + a / j, or 2 sqrt(v / j) if a is never reached.
    full = abs(goal) > 1.0 / 4.0
    expected = abs(goal) + 1.0 / 4.0 if full else 2.0 * math.sqrt(abs(goal) / 4.0)
    arrived = np.flatnonzero(np.abs(speed - goal) > 1e-3)[-1] * dt
    assert arrived == pytest.approx(expected, abs=0.06)


def test_a_limit_that_falls_below_the_command_is_met_as_fast_as_braking_allows():
    for jerk in ({}, {"max_linear_jerk": 0.1, "max_angular_jerk": 0.1}):
        limits = {"max_linear_vel": 0.2, "max_linear_decel": 1.0, "max_angular_vel": 0.5, **jerk}
        command = after((0.2, 0.5), (0.9, 0.7), max_angular_accel=1.0, **limits)
        np.testing.assert_allclose(command, (0.8, 0.6))


def test_a_batch_is_limited_robot_by_robot():
    limits = {"max_linear_accel": 2.0, "max_linear_decel": 4.0, "max_angular_accel": 3.0}
    random = np.random.default_rng(0)
    wanted, previous = random.uniform(-1.0, 1.0, (2, 50, 2))
    together = after(wanted, previous, **limits)
    for index in range(50):
        np.testing.assert_array_equal(
            together[index], after(wanted[index], previous[index], **limits)
        )
