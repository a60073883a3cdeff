"""Fault scripts: when what holds, and one sentence for everything that is wrong with them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build
from adp_path_follower.study.simulation.simulate import simulate
from folders import CONFIG
from sim_unicycle.fault_script import read_fault_script
from sim_unicycle.settings import PlantSettings, SimulatorSettings

SHIPPED = sorted((CONFIG / "faults").glob("*.yaml"))


def script_of(folder, *entries):
    file = folder / "script.yaml"
    file.write_text(yaml.safe_dump({"faults": list(entries)}))
    return read_fault_script(str(file))


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
def test_shipped_scripts_can_be_read_and_say_what_the_robot_should_do(file):
    script, settings = read_fault_script(file.stem), SimulatorSettings()
    changed = {script.settings_at(settings, 0.01 * step) != settings for step in range(4000)}
    assert changed == {True} or changed == {True, False}
    text = file.read_text()
    assert text.startswith(("# Stops", "# Drives"))
    assert text.count("#") == 1


def test_values_hold_for_their_time_and_the_later_entry_wins(tmp_path):
    script = script_of(
        tmp_path,
        {"at": 1.0, "for": 2.0, "position_noise": 0.1, "friction": 0.5},
        {"at": 2.0, "for": 2.0, "position_noise": 0.3},
    )
    base = build(SimulatorSettings, {"heading_noise": 0.7})
    expected = {
        0.99: (0.0, math.inf),
        1.0: (0.1, 0.5),
        2.0: (0.3, 0.5),
        2.99: (0.3, 0.5),
        3.0: (0.3, math.inf),
        4.0: (0.0, math.inf),
    }
    for time, (noise, friction) in expected.items():
        plant = script.settings_at(base, time).plant
        assert (plant.position_noise, plant.friction, plant.heading_noise) == (noise, friction, 0.7)
    assert script.settings_at(base, 0.5) is base
    # A parameter that the user changes meanwhile counts again afterwards.
    other = build(SimulatorSettings, {"position_noise": 0.9})
    assert script.settings_at(other, 2.5).plant.position_noise == 0.3
    assert script.settings_at(other, 9.0).plant.position_noise == 0.9


@settings(max_examples=50)
@given(
    at=st.integers(0, 300),
    duration=st.integers(1, 50),
    pause=st.integers(1, 100),
    step=st.integers(0, 2000),
)
def test_entries_repeat_on_the_grid_of_steps(tmp_path_factory, at, duration, pause, step):
    every = duration + pause
    script = script_of(
        tmp_path_factory.mktemp("script"),
        {"at": at / 100, "for": duration / 100, "every": every / 100, "odometry_drop": 1.0},
    )
    holds = script.settings_at(SimulatorSettings(), step * 0.01).plant.odometry_drop == 1.0
    assert holds == (step >= at and (step - at) % every < duration)


def test_pauses_that_no_picture_shows_are_left_out(tmp_path):
    fast = {"at": 1.0, "for": 4e-7, "every": 1e-6, "linear_slip": 0.1}
    slow = {"at": 0.5, "for": 1.0, "every": 2.0, "push": [0.0, 1.0, 0.0]}
    spans = script_of(tmp_path, fast, slow).spans(300.0)
    assert spans[0].tolist() == [1.0, 300.0]
    assert spans[1:].tolist() == [[0.5 + k, 1.5 + k] for k in range(0, 300, 2)]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "is empty"),
        ("[1", "line 1: not YAML"),
        ("a: 1", "no fault script: it must have one key, 'faults', a list"),
        ("faults: 3", "'faults' must be a list of entries"),
        ("faults: []", "'faults' must be a list of entries"),
        ("faults: [7]", "entry 1: 7 is no mapping"),
        ("faults: [{friction: 1.0}]", "entry 1: 'at' is missing"),
        ("faults: [{at: -1, friction: 1.0}]", "entry 1: 'at' is -1, but must be a number of at"),
        ("faults: [{at: .nan, friction: 1.0}]", "entry 1: 'at' is nan"),
        ("faults: [{at: true, friction: 1.0}]", "entry 1: 'at' is True"),
        ("faults: [{at: 1, for: 0, friction: 1.0}]", "'for' is 0, but must be a number above 0"),
        ("faults: [{at: 1, for: 2, every: 2, friction: 1.0}]", "must be longer than 'for'"),
        ("faults: [{at: 1, every: 2, friction: 1.0}]", "must be longer than 'for'"),
        ("faults: [{at: 1}]", "entry 1: it changes nothing"),
        (
            "faults: [{at: 1, friction: 1.0}, {at: 2, fricton: 1.0}]",
            "entry 2: 'fricton' is no parameter of the simulator; did you mean 'friction'?",
        ),
        ("faults: [{at: 1, rate: 5.0}]", "entry 1: 'rate' cannot change while running"),
        ("faults: [{at: 1, friction: ice}]", "entry 1: setting 'friction' is 'ice', but must be"),
        ("faults: [{at: 1, push: [1.0]}]", "entry 1: setting 'push' is [1.0], but must be"),
    ],
)
def test_a_bad_script_is_one_sentence(tmp_path, content, expected):
    file = tmp_path / "bad.yaml"
    file.write_text(content)
    with pytest.raises(AdpError) as refused:
        read_fault_script(str(file))
    assert expected in str(refused.value)
    assert str(file) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_names_that_nobody_knows_are_refused_with_those_that_are():
    with pytest.raises(AdpError, match=r"'pushh' is neither a file nor one of .*, push, "):
        read_fault_script("pushh")
    with pytest.raises(AdpError, match=r"missing\.yaml cannot be read"):
        read_fault_script("missing.yaml")
    assert read_fault_script("").entries == ()


junk = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["faults", "at", "for", "every", "push", "friction", "seed", ""]),
            inner,
            max_size=4,
        )
    ),
    max_leaves=12,
)


@settings(max_examples=150)
@given(content=junk | st.fixed_dictionaries({"faults": st.lists(junk, max_size=3)}))
def test_whatever_a_script_holds_it_is_taken_or_refused(tmp_path_factory, content):
    file = tmp_path_factory.mktemp("script") / "any.yaml"
    file.write_text(yaml.safe_dump(content))
    try:
        script = read_fault_script(str(file))
    except AdpError:
        return
    assert all(entry.values for entry in script.entries)


def test_lock_step_refuses_faulty_messages():
    with pytest.raises(AdpError, match="'clock_stops' is True, but lock-step waits for an answer"):
        build(SimulatorSettings, {"lockstep": True, "clock_stops": True})
    assert read_fault_script("clock_stops").changes_messages() == "clock_stops"
    assert read_fault_script("push").changes_messages() == ""


def test_a_simulation_replays_a_script(tmp_path):
    """A push of 0.5 m to the left on a straight line, with a robot that does not drive."""
    script = script_of(tmp_path, {"at": 0.2, "for": 0.25, "push": [0.0, 2.0, 0.0]})
    stuck = PlantSettings(max_linear_vel=0.0, max_angular_vel=0.0)
    found = simulate(
        build(Settings, {}),
        named_path("line"),
        np.zeros((2, 3)),
        duration=1.0,
        plant=stuck,
        faults=script,
        record=True,
    )
    lateral = found.trajectories.pose[:, :, 1]
    np.testing.assert_allclose(lateral[:, 20], 0.0, atol=1e-12)
    np.testing.assert_allclose(lateral[:, 45:], 0.5, atol=1e-9)
