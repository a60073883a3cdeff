"""The report's figures of a recorded robot model."""

from __future__ import annotations

import numpy as np
import pytest
from robots import TYPICAL

from adp_path_follower.analysis.bag_analysis import analyse_bag
from bag_messages import SECOND, array, path_message, write_bag
from driven_robots import BEGIN, driven, slalom

NAMES = ("delay [s]", "linear lag [s]", "angular lag [s]", "k_v", "k_w", "bias [rad/m]")
LABEL = ", ".join(
    [
        *NAMES,
        "ramp [m/s^2]",
        "angular ramp [rad/s^2]",
        *(f"deviation of {name}" for name in NAMES),
        "explained",
    ]
)


def charts_of_a_bag(folder, told):
    messages = [
        ("/path", BEGIN, path_message([[0.0, 0.0], [20.0, 0.0]])),
        *driven(TYPICAL, slalom, duration=12.0, stamped=True),
    ]
    for second in range(1, 12):
        numbers = array(told(second), LABEL)
        messages.append(("/path_follower/robot_model", BEGIN + second * SECOND, numbers))
    messages.sort(key=lambda item: item[1])
    return analyse_bag(write_bag(folder / "bag", messages), {}, 1, None).charts


def test_parameters_and_velocities_are_shown_where_they_were_recorded(tmp_path):
    def told(second):
        delay = TYPICAL.delay * (1.0 - 1.0 / second**2)
        parameters = [delay, TYPICAL.lag, TYPICAL.lag, *TYPICAL.gains, *TYPICAL.ramps]
        return [*parameters, *(0.1 / second,) * 6, 0.9]

    panels = charts_of_a_bag(tmp_path, told).panels
    times, _, bias = panels["robot_model"]
    low, high, delay = times.lines[:3]
    assert (low.background, high.background, delay.name) == (True, True, "delay")
    seconds = np.arange(1, 12)
    np.testing.assert_allclose(np.diff(delay.time), 1.0, atol=1e-6)
    np.testing.assert_allclose(delay.values, TYPICAL.delay * (1.0 - seconds**-2.0), atol=1e-12)
    np.testing.assert_allclose(high.values - low.values, 0.4 / seconds, atol=1e-12)
    np.testing.assert_allclose(bias.lines[2].values, TYPICAL.gains[2], atol=1e-12)
    noises = TYPICAL.linear_noise, TYPICAL.angular_noise
    for panel, noise in zip(panels["robot_velocity"], noises, strict=True):
        measured, model = panel.lines
        expected = np.interp(measured.time, model.time, model.values)
        # The encoders' noise alone is left, by a model of another program's robot.
        assert np.std(measured.values - expected) < 1.5 * noise
        assert np.std(measured.values) > 5.0 * noise


def test_a_robot_of_which_nothing_is_learned_has_no_band_and_a_fitting_axis(tmp_path):
    """The deviations with which learning begins would dwarf every estimate."""

    def told(second):
        lags, gains = [0.3] * 3, [0.1 / second**2] * 3
        return [0.0, 0.0, 0.0, 1.0, 1.0, 0.0, np.inf, np.inf, *lags, *gains, 0.9]

    times, gains, bias = charts_of_a_bag(tmp_path, told).panels["robot_model"]
    assert [line.background for line in times.lines] == [False] * 3
    assert times.span == (-0.05, 0.05)
    assert sum(line.background for line in gains.lines) == 4
    assert gains.span == pytest.approx((0.98, 1.02))
    assert bias.span == pytest.approx((-0.02, 0.02))


def test_models_of_other_versions_and_damaged_ones_show_nothing(tmp_path):
    damaged = charts_of_a_bag(tmp_path / "damaged", lambda second: [np.nan] * 15).panels
    assert "robot_velocity" not in damaged
    other = charts_of_a_bag(tmp_path / "other", lambda second: [0.1] * 14).panels
    assert not {"robot_model", "robot_velocity"} & set(other)
