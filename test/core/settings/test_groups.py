"""Settings: what is accepted keeps its value, and the rest is refused in a sentence."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import (
    build,
    flatten,
    setting_fields,
    unknown_name,
    update,
)
from sim_unicycle.settings import SimulatorSettings

TREES = {"controller": Settings, "simulator": SimulatorSettings}
every_tree = pytest.mark.parametrize("tree", TREES.values(), ids=TREES.keys())
CONTROLLER_NAMES = sorted(flatten(build(Settings, {})))
SIMULATOR_NAMES = sorted(flatten(build(SimulatorSettings, {})))


# --- refusals -----------------------------------------------------------------------------------

NINE_ZEROS = [0.0] * 9
REFUSALS = [
    # wrong types
    ("desired_speed", "fast", "a number"),
    ("desired_speed", True, "a number"),
    ("desired_speed", None, "a number"),
    ("desired_speed", [0.5], "a number"),
    ("desired_speed", {"value": 0.5}, "a number"),
    ("learning", 1, "true or false"),
    ("learning", "true", "true or false"),
    ("basis", 7, "text|paper"),
    ("state_cost", 1.0, "list of numbers"),
    ("state_cost", "1, 1, 1", "list of numbers"),
    ("state_cost", b"111", "list of numbers"),
    ("state_cost", None, "list of numbers"),
    ("state_cost", {1: "s", 2: "y", 3: "theta"}, "list of numbers"),
    ("state_cost", {1.0, 2.0, 3.0}, "list of numbers"),
    ("samples_per_axis", [3, 3, 3, 3.0], "integers"),
    ("samples_per_axis", [3, 3, 3, True], "integers"),
    ("samples_per_axis", [3, 3, "3", 3], "integers"),
    # out of range
    ("desired_speed", 0, "above 0"),
    ("desired_speed", -0.5, "above 0"),
    ("desired_speed", 21.0, "20"),
    ("desired_speed", math.nan, "above 0|number"),
    ("desired_speed", math.inf, "20"),
    ("desired_speed", 10**400, "20"),
    ("min_linear_vel", 0.1, "0"),
    ("min_linear_vel", math.nan, "0|number"),
    ("max_linear_vel", 0.0, "above 0"),
    ("max_angular_vel", -1.0, "above 0"),
    ("basis", "cubic", "paper_misprinted"),
    ("control_trigger", "Timer", "odometry"),
    ("critic_gain_sampled", -1e-9, "0"),
    ("sample_half_widths", [1.0, 1.0, 1.0, 0.0], "above 0"),
    ("sample_half_widths", [1.0, 1.0, 1.0, 1.0], "below 1"),
    ("sample_half_widths", [1.0, 1.0, 1.0], "4 values"),
    ("samples_per_axis", [3, 3, 3], "4 values"),
    ("samples_per_axis", [3, 3, 3, 0], "1"),
    ("samples_per_axis", [50, 50, 50, 1], "10000"),
    ("samples_per_axis", [10**30, 1, 1, 1], "50"),
    ("basis", "paper", "path_state"),  # its terms of phi
    ("basis_degree", 1, "2"),
    ("sample_count", 100, "160"),
    ("preview_distance", 0.3, "knot_spacing"),
    ("wide_region_levels", [5.0, 4.5], "rise"),
    ("initial_critic_weights", [*NINE_ZEROS[1:], math.nan], "1e+06|number"),
    # costs
    ("state_cost", [1.0, 1.0], "3 or 9"),
    ("state_cost", [1.0, 1.0, -1e-6], "positive semidefinite"),
    ("state_cost", [1.0, 0.0, 0.0, 0.0, 1.0, 2.0, 0.0, 2.0, 1.0], "positive semidefinite"),
    ("state_cost", [1.0, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], "symmetric"),
    ("state_cost", [1.0, 1.0, math.inf], "finite"),
    ("state_cost", [1.0, 1.0, math.nan], "finite|number"),
    ("input_cost", [1.0, 0.0], "positive definite"),
    ("input_cost", [1.0, -1.0], "positive definite"),
    ("input_cost", [1e-320, 1.0], "positive definite"),  # its inverse is infinite
    ("input_cost", [1.0, 2.0, 2.0, 1.0], "positive definite"),
    ("input_cost", [1.0, 1.0, 1.0, 1.0], "positive definite"),
    ("input_cost", [1.0, 0.1, 0.2, 1.0], "symmetric"),
    ("input_cost", [1.0, 1.0, 1.0], "2 or 4"),
]
SIMULATOR_REFUSALS = [
    ("rate", 0.0, "1"),
    ("rate", "100", "a number"),
    ("seed", 1.0, "integer"),
    ("seed", -1, "0"),
    ("seed", 2**31, "2"),
    ("lockstep", "yes", "true or false"),
    ("odom_frame", 3, "text"),
    ("position_noise", -0.1, "0"),
    ("max_linear_vel", -1.0, "0"),
    ("real_time_factor", 2.0, "publish_clock"),
    ("x", math.nan, "number"),
    ("x", math.inf, ""),
    ("theta", -math.inf, ""),
]


def refusal_ids(cases):
    return [f"{name}={value!r:.40}" for name, value, _ in cases]


def refused(tree, name, value, allowed):
    with pytest.raises(SettingsError) as caught:
        build(tree, {name: value})
    message = str(caught.value)
    assert f"'{name}'" in message
    assert any(words in message for words in allowed.split("|"))
    assert "\n" not in message
    if isinstance(value, list) and len(value) not in (8, 10, 0):
        assert str(value[-1]) in message
    elif isinstance(value, float):
        assert str(value) in message or f"{value:g}" in message
    elif not isinstance(value, list | int):
        assert str(value) in message
    elif isinstance(value, int) and value < 2**32:
        assert f"{value:g}" in message or str(value) in message


@pytest.mark.parametrize(("name", "value", "allowed"), REFUSALS, ids=refusal_ids(REFUSALS))
def test_bad_settings_of_the_controller_are_refused(name, value, allowed):
    refused(Settings, name, value, allowed)


@pytest.mark.parametrize("name", ["initial_critic_weights", "initial_actor_weights"])
@pytest.mark.parametrize(
    ("basis", "count", "needed"), [("paper", 8, 9), ("paper", 0, 9), ("polynomial", 9, 80)]
)
def test_listed_weights_must_fit_the_basis(name, basis, count, needed):
    values = {"basis": basis, "scheduling": "path_state", "initial_weights": "listed"}
    fitting = {
        other: [0.0] * needed for other in ("initial_critic_weights", "initial_actor_weights")
    }
    with pytest.raises(SettingsError, match=rf"'{name}' has {count} values.* needs {needed}:"):
        build(Settings, {**values, **fitting, name: [0.0] * count})
    build(Settings, {**values, **fitting})


def test_the_quadratic_weights_alone_will_do_for_a_polynomial():
    build(Settings, {"initial_weights": "listed", "initial_critic_weights": [1.0] * 6})


@pytest.mark.parametrize(
    ("name", "value", "allowed"), SIMULATOR_REFUSALS, ids=refusal_ids(SIMULATOR_REFUSALS)
)
def test_bad_settings_of_the_simulator_are_refused(name, value, allowed):
    refused(SimulatorSettings, name, value, allowed)


@pytest.mark.parametrize(
    ("name", "proposal"),
    [
        ("desired_sped", "'desired_speed'"),
        ("max_linear_velocity", "'max_linear_vel'"),
        ("Basis", "'basis'"),
        ("zzz", "`adp parameters` lists all"),
        ("", "`adp parameters` lists all"),
    ],
)
def test_unknown_names_are_refused_with_the_nearest_known_one(name, proposal):
    with pytest.raises(SettingsError) as caught:
        build(Settings, {"desired_speed": 0.3, name: 1.0})
    assert f"unknown setting '{name}'" in str(caught.value)
    assert proposal in str(caught.value)


def test_a_proposal_comes_only_from_the_known_names():
    assert "'rate'" in unknown_name("rat", ["rate", "range"])
    assert "did you mean" not in unknown_name("rat", ["odom_frame"])


# --- costs --------------------------------------------------------------------------------------


@settings(max_examples=80)
@given(rows=npst.arrays(np.int64, (2, 3), elements=st.integers(-9, 9)))
@example(rows=np.array([[1, 1, 1], [0, 0, 0]]))
@example(rows=np.array([[1, 2, 3], [0, 0, 0]]))
def test_every_positive_semidefinite_state_cost_is_accepted(rows):
    matrix = (rows.T @ rows).astype(float)  # exact, of rank 2 at most
    given_cost = matrix.ravel().tolist()
    found = build(Settings, {"state_cost": given_cost}).cost.state_cost_matrix()
    np.testing.assert_array_equal(found, matrix)


@settings(max_examples=60)
@given(root=npst.arrays(float, (2, 2), elements=st.floats(-3.0, 3.0)), margin=st.floats(1e-3, 10.0))
def test_every_positive_definite_input_cost_is_accepted(root, margin):
    matrix = root @ root.T
    matrix = 0.5 * (matrix + matrix.T) + margin * np.eye(2)
    tuning = build(Settings, {"input_cost": tuple(matrix.ravel().tolist())})
    np.testing.assert_array_equal(tuning.cost.input_cost_matrix(), matrix)


@settings(max_examples=60)
@given(entries=st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_indefinite_input_costs_are_refused(entries):
    first, mixed, second = entries
    # Sylvester's criterion, away from the boundary.
    determinant = first * second - mixed * mixed
    values = {"input_cost": [first, mixed, mixed, second]}
    if first > 1e-6 and determinant > 1e-6:
        build(Settings, values)
    elif first < -1e-6 or determinant < -1e-6:
        with pytest.raises(SettingsError, match="positive definite"):
            build(Settings, values)


def test_costs_by_their_diagonal_are_the_matrices():
    tuning = build(Settings, {"state_cost": [1, 2, 3], "input_cost": [4, 0.5]})
    np.testing.assert_array_equal(tuning.cost.state_cost_matrix(), np.diag([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(tuning.cost.input_cost_matrix(), np.diag([4.0, 0.5]))


# --- good values --------------------------------------------------------------------------------

VALID = {
    "desired_speed": st.floats(1e-3, 20.0),
    "target_gain": st.floats(1e-3, 100.0),
    "state_cost": st.lists(st.floats(0.0, 10.0), min_size=3, max_size=3),
    "input_cost": st.lists(st.floats(0.1, 10.0), min_size=2, max_size=2),
    "min_linear_vel": st.floats(max_value=0.0, allow_nan=False),
    "max_linear_vel": st.floats(min_value=1e-3, allow_nan=False),
    "learning": st.booleans(),
    "basis_degree": st.integers(2, 6),
    "frame": st.sampled_from(["serret_frenet", "half_angle"]),
    "wide_region": st.sampled_from(["none", "riccati", "approach"]),
    "actor_gain": st.one_of(st.floats(0.0, 1e4), st.integers(0, 10_000)),
    "sample_half_widths": st.tuples(*[st.floats(1e-3, 0.9)] * 4),
    "samples_per_axis": st.tuples(*[st.integers(1, 10)] * 4),
    "initial_critic_weights": st.lists(st.floats(-1e6, 1e6), min_size=9, max_size=9),
    "control_trigger": st.sampled_from(["timer", "odometry"]),
    "odom_timeout": st.floats(0.01, 60.0),
}
good_values = st.fixed_dictionaries({}, optional=VALID)


@settings(max_examples=80)
@given(values=good_values)
def test_settings_are_what_was_given_and_survive_a_round_trip(values):
    tuning = build(Settings, values)
    flat = flatten(tuning)
    defaults = flatten(build(Settings, {}))
    assert set(flat) == set(defaults)
    for name, value in flat.items():
        expected = values.get(name, defaults[name])
        assert value == (tuple(expected) if isinstance(expected, list) else expected)
        assert type(value) is type(defaults[name])
    assert build(Settings, flat) == tuning


@settings(max_examples=60)
@given(before=good_values, changes=good_values)
def test_an_update_replaces_what_it_names_and_nothing_else(before, changes):
    tuning = build(Settings, before)
    unchanged = flatten(tuning)
    found = flatten(update(tuning, changes))
    for name, value in found.items():
        expected = changes.get(name, unchanged[name])
        assert value == (tuple(expected) if isinstance(expected, list) else expected)
    assert flatten(tuning) == unchanged


def test_a_refused_update_changes_nothing():
    tuning = build(Settings, {"desired_speed": 0.3})
    with pytest.raises(SettingsError, match="'desired_speed'"):
        update(tuning, {"target_gain": 0.7, "desired_speed": -1.0})
    assert tuning == build(Settings, {"desired_speed": 0.3})
    assert flatten(tuning)["target_gain"] == flatten(build(Settings, {}))["target_gain"]


def test_arrays_of_numbers_are_lists_of_numbers():
    by_array = build(Settings, {"state_cost": np.array([1.0, 2.0, 3.0])})
    assert by_array == build(Settings, {"state_cost": [1.0, 2.0, 3.0]})


@every_tree
def test_defaults_are_valid_and_frozen(tree):
    tuning = build(tree, {})
    for field in setting_fields(tree):
        group = getattr(tuning, field.group)
        assert getattr(group, field.name) == field.default
        with pytest.raises(AttributeError):
            setattr(group, field.name, field.default)


# --- any values ---------------------------------------------------------------------------------

scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.integers(-60, 60),
    st.sampled_from([10**400, -(10**400), math.nan, math.inf, -math.inf, 1e308, 5e-324]),
    st.floats(),
    st.floats(0.0, 1.0),
    st.text(max_size=5),
    st.sampled_from(["paper", "timer", "nearest"]),
)
yaml_values = st.recursive(
    scalars,
    lambda inner: st.one_of(
        st.lists(inner, max_size=9), st.dictionaries(st.text(max_size=3), inner, max_size=3)
    ),
    max_leaves=12,
)
number_lists = st.one_of(
    *(
        st.lists(st.one_of(st.floats(), st.floats(-2.0, 2.0), st.integers(0, 3)), **size)
        for size in (
            {"max_size": 3},
            {"min_size": 4, "max_size": 4},
            {"min_size": 9, "max_size": 9},
        )
    )
)
any_values = st.one_of(yaml_values, number_lists)


@settings(max_examples=400)
@given(values=st.dictionaries(st.sampled_from(CONTROLLER_NAMES), any_values, max_size=3))
@example(values={"state_cost": [1e308] * 9})
@example(values={"input_cost": [1e308, 1e308]})
@example(values={"input_cost": [1e308, -1e308, -1e308, 1e308]})
def test_any_values_make_controller_settings_or_are_refused(values):
    settings_or_refusal(Settings, values)


@settings(max_examples=200)
@given(values=st.dictionaries(st.sampled_from(SIMULATOR_NAMES), any_values, max_size=3))
def test_any_values_make_simulator_settings_or_are_refused(values):
    settings_or_refusal(SimulatorSettings, values)


def settings_or_refusal(tree, values):
    try:
        tuning = build(tree, values)
    except SettingsError as refusal:
        named = [name for name in values if f"'{name}'" in str(refusal)]
        one_sentence = "\n" not in str(refusal)
    else:
        for name, value in values.items():
            kept = flatten(tuning)[name]
            assert kept == (tuple(value) if isinstance(value, list) else value)
        return
    assert named
    assert one_sentence


@settings(max_examples=100)
@given(name=st.text(max_size=20), value=yaml_values)
def test_any_unknown_name_is_refused(name, value):
    if name in CONTROLLER_NAMES:
        return
    with pytest.raises(SettingsError, match="unknown setting"):
        build(Settings, {name: value})
