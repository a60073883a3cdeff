"""Settings as text: YAML values and the parameter table."""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from adp_path_follower.core.files import parse_yaml
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import (
    describe_table,
    setting_fields,
    titled_fields,
    yaml_text,
)
from sim_unicycle.settings import SimulatorSettings

TREES = {"controller": Settings, "simulator": SimulatorSettings}
every_tree = pytest.mark.parametrize("tree", TREES.values(), ids=TREES.keys())


def assert_read_alike(text, value):
    read = parse_yaml(text)
    if isinstance(value, tuple):
        assert isinstance(read, list)
        assert [type(item) for item in read] == [type(item) for item in value]
        assert read == list(value)
    else:
        assert type(read) is type(value)
        assert read == value


@every_tree
def test_defaults_are_read_back_from_yaml_with_their_type(tree):
    for field in setting_fields(tree):
        assert_read_alike(yaml_text(field.default), field.default)


@settings(max_examples=150)
@given(
    value=st.one_of(
        st.booleans(),
        st.integers(),
        st.floats(allow_nan=False),
        st.lists(st.floats(allow_nan=False), max_size=5).map(tuple),
        st.lists(st.integers(), max_size=5).map(tuple),
    )
)
@example(value=1e-7)
@example(value=1e16)
@example(value=-0.0)
@example(value=(1e22, 5e-324))
def test_numbers_are_read_back_from_yaml_with_their_type(value):
    text = yaml_text(value)
    assert_read_alike(text, value)
    if isinstance(value, float):
        assert "." in text  # ROS takes a number without a point for an integer


@settings(max_examples=80)
@given(value=st.text("".join(map(chr, range(32, 127))) + "äφ€😀", max_size=12))
@example(value='a "quoted" name')
@example(value="back\\slash")
@example(value="true")
@example(value="1.5")
def test_texts_are_read_back_from_yaml(value):
    assert_read_alike(yaml_text(value), value)


@every_tree
def test_the_table_has_a_row_for_every_setting(tree):
    table = describe_table(tree)
    rows = [line for line in table.splitlines() if line.startswith("- `")]
    fields = setting_fields(tree)
    assert len(rows) == len(fields)
    for row, field in zip(rows, fields, strict=True):
        spec = field.spec
        assert row.startswith(f"- `{field.name}`")
        assert row.endswith(f": {spec.doc}")
        assert f" = `{yaml_text(field.default)}`" in row
        assert f" {spec.symbol} = `" in row or not spec.symbol
        assert f"` {spec.unit}" in row or not spec.unit
        assert all(choice in row for choice in spec.choices)
        assert ("fixed):" in row) is bool(spec.read_only)
    titles = [title for title, _ in titled_fields(tree) if title]
    assert len(titles) == len({field.group for field in fields})
    for title in titles:
        assert f"### {title}\n" in table


@every_tree
def test_names_are_plain_and_every_setting_is_explained(tree):
    for field in setting_fields(tree):
        assert field.name.isidentifier()
        assert field.name == field.name.lower()
        assert field.spec.doc.endswith(".")
