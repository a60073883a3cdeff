"""Parameter files and assignments: read back as written, and refused by name and cause."""

import contextlib
import re

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from adp_path_follower.core.errors import AdpError, FileError, SettingsError
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import (
    load_settings,
    parameter_file_text,
    parse_assignment,
    read_parameters,
)
from adp_path_follower.core.settings.schema import build, flatten, setting_fields
from sim_unicycle.settings import SimulatorSettings

NODE = "path_follower"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("parameters")


def written(folder, content):
    file = folder / "parameters.yaml"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return file


@settings(max_examples=40)
@given(
    values=st.fixed_dictionaries(
        {},
        optional={
            "desired_speed": st.floats(1e-6, 20.0),
            "state_cost": st.lists(st.floats(0.0, 1e20), min_size=3, max_size=3),
            "min_linear_vel": st.floats(max_value=0.0, allow_nan=False),
            "learning": st.booleans(),
            "samples_per_axis": st.tuples(*[st.integers(1, 10)] * 4),
            "control_trigger": st.sampled_from(["timer", "odometry"]),
        },
    )
)
def test_settings_are_read_back_from_their_file(folder, values):
    tuning = build(Settings, values)
    file = written(folder, parameter_file_text(tuning, NODE))
    assert load_settings(Settings, NODE, file) == tuning


@pytest.mark.parametrize("tree", [Settings, SimulatorSettings])
def test_a_file_explains_every_setting_above_it(tree):
    text = parameter_file_text(build(tree, {}), NODE)
    comments = ""
    explained = {}
    for line in text.splitlines():
        entry = re.match(r"    (\w+): ", line)
        if entry:
            explained[entry.group(1)] = " ".join(comments.split())
            comments = ""
        else:
            comments += line.replace("#", " ")
        assert len(line) <= 100
    for field in setting_fields(tree):
        assert " ".join(field.spec.doc.split()) in explained[field.name]


def test_sections_for_the_node_count_in_their_order(folder):
    file = written(
        folder,
        """
/**:
  ros__parameters: {desired_speed: 0.1, target_gain: 0.2, actor_gain: 3.0, use_sim_time: true}
/**/path_follower:
  ros__parameters: {target_gain: 0.4, qos_overrides./odom.subscription.depth: 3}
another_node:
  ros__parameters: {desired_speed: 9.0}
/robot/path_follower:
  ros__parameters: {actor_gain: 2}
""",
    )
    expected = {"desired_speed": 0.1, "target_gain": 0.4, "actor_gain": 2}
    assert read_parameters(file, NODE) == expected
    found = flatten(load_settings(Settings, NODE, file, ["actor_gain=7.5", "learning=false"]))
    assert found["desired_speed"] == 0.1
    assert found["actor_gain"] == 7.5
    assert found["learning"] is False
    assert found["odom_timeout"] == flatten(build(Settings, {}))["odom_timeout"]


def test_without_a_file_there_are_the_defaults():
    assert load_settings(Settings, NODE) == build(Settings, {})


@pytest.mark.parametrize(
    ("content", "kind", "words"),
    [
        ("", FileError, "empty"),
        ("desired_speed: 0.4", FileError, NODE),
        ("other:\n  ros__parameters: {desired_speed: 0.4}", FileError, NODE),
        ("[1, 2]", FileError, "parameter file"),
        ("path_follower: 7", FileError, "ros__parameters"),
        ("path_follower: {desired_speed: 0.4}", FileError, "ros__parameters"),
        ("path_follower: {ros__parameters: [1]}", FileError, "ros__parameters"),
        ("path_follower: {ros__parameters: {desired_sped: 1.0}}", SettingsError, "desired_speed"),
        ("path_follower: {ros__parameters: {desired_speed: fast}}", SettingsError, "'fast'"),
        ("path_follower: {ros__parameters: {7: 1.0}}", SettingsError, "'7'"),
    ],
)
def test_bad_files_are_refused(folder, content, kind, words):
    file = written(folder, content)
    with pytest.raises(kind) as caught:
        load_settings(Settings, NODE, file)
    message = str(caught.value)
    assert words in message
    assert "\n" not in message
    if kind is FileError:
        assert str(file) in message


@settings(max_examples=120)
@given(
    content=st.one_of(
        st.binary(max_size=40),
        st.binary(max_size=30).map(b"path_follower: {ros__parameters: {basis: ".__add__),
        st.text(max_size=20)
        .map(lambda text: "path_follower: {ros__parameters: {" + text + ": 1}}")
        .map(str.encode),
    )
)
def test_any_content_gives_settings_or_is_refused(folder, content):
    with contextlib.suppress(AdpError):
        assert isinstance(load_settings(Settings, NODE, written(folder, content)), Settings)


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("desired_speed=0.3", "desired_speed", 0.3),
        (" basis = paper", "basis", "paper"),
        ("max_linear_vel=.inf", "max_linear_vel", float("inf")),
        ("state_cost=[1, 2.0, 1e-3]", "state_cost", [1, 2.0, 0.001]),
        ("learning=false", "learning", False),
        ("odom_frame=a=b", "odom_frame", "a=b"),
    ],
)
def test_assignments_have_yaml_values(text, name, value):
    assert parse_assignment(text) == (name, value)
    assert type(parse_assignment(text)[1]) is type(value)


@pytest.mark.parametrize("text", ["", "desired_speed", "=1", "  =1", "a=[1", "a=2001-99-99"])
def test_bad_assignments_are_refused(text):
    with pytest.raises(SettingsError) as caught:
        parse_assignment(text)
    assert text.partition("=")[0].strip() in str(caught.value)


@settings(max_examples=100)
@given(text=st.text(max_size=20), name=st.sampled_from(["", "desired_speed=", "basis="]))
@example(text="[" * 500, name="basis=")
def test_any_assignment_gives_settings_or_is_refused(name, text):
    with contextlib.suppress(SettingsError):
        assert isinstance(load_settings(Settings, NODE, None, [name + text]), Settings)
