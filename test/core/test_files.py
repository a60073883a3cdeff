"""Files of any content: values, or an error with the file's name."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.errors import AdpError, FileError
from adp_path_follower.core.files import (
    expanded,
    parse_yaml,
    read_csv_columns,
    read_text,
    read_yaml,
)
from adp_path_follower.core.path.library import path_from_file


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("files")


csv_parts = st.sampled_from(
    ["x,y", "\n", "\r\n", ",", "0", "1.5", "-2", "1e3", "nan", "a", '"', "\0", " ", "\t", "\x85"]
)
yaml_parts = st.sampled_from(
    [
        *["points", ":", " ", "\n", "- ", "[", "]", "{", "}", ",", "0", "1", "2.5", "1e3", ".nan"],
        *["closed", "true", "&a", "*a", "!!int", "!!binary", "2001-99-99", "0x_", "? ", "|", ">"],
        *["'", '"', "#", "%", "@", "\t", "---", "...", "<<", "~", "é", "\x07", "points: [[0, 0],"],
    ]
)


@settings(max_examples=150)
@given(
    content=st.one_of(
        st.binary(max_size=60),
        st.binary(max_size=40).map(b"x,y\n0,0\n1,1\n".__add__),
        st.lists(csv_parts, max_size=25).map(lambda parts: "".join(parts).encode()),
    )
)
def test_any_csv_file_gives_a_path_or_an_error_with_its_name(folder, content):
    any_content(folder / "any.csv", content)


@settings(max_examples=300)
@given(
    content=st.one_of(
        st.binary(max_size=60),
        st.binary(max_size=40).map(b"points: ".__add__),
        st.lists(yaml_parts, max_size=25).map(lambda parts: "".join(parts).encode()),
        st.lists(yaml_parts, max_size=8).map(lambda parts: ("points: " + "".join(parts)).encode()),
    )
)
def test_any_yaml_file_gives_a_path_or_an_error_with_its_name(folder, content):
    any_content(folder / "any.yaml", content)


def any_content(file, content):
    file.write_bytes(content)
    try:
        path = path_from_file(file)
    except AdpError as error:
        message = str(error)
    else:
        assert path.length > 0.0
        return
    assert str(file) in message


@settings(max_examples=60)
@given(
    rows=st.lists(
        st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 3), min_size=1, max_size=8
    )
)
def test_columns_of_a_csv_file_are_read_exactly(folder, rows):
    file = folder / "numbers.csv"
    file.write_text("y,other,x\n" + "".join(f"{a!r},{b!r},{c!r}\n" for a, b, c in rows))
    columns = read_csv_columns(file, ("x", "y"))
    assert columns.tolist() == [[c, a] for a, _, c in rows]


def test_text_is_read_as_utf_8_with_or_without_a_mark(folder):
    file = folder / "text.txt"
    for mark in (b"", b"\xef\xbb\xbf"):
        file.write_bytes(mark + "Größe φ\n".encode())
        assert read_text(file) == "Größe φ\n"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "empty"),
        (b"\n \n", "empty"),
        (b"\xe9t\xe9", "UTF-8"),
        ("été".encode("utf-16"), "UTF-8"),
        (b"a\0b", "NUL"),
    ],
)
def test_content_that_is_no_text_is_refused(folder, content, words):
    file = folder / "bad.txt"
    file.write_bytes(content)
    with pytest.raises(FileError, match=words) as caught:
        read_text(file)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 1e-3),
        ("1E+3", 1e3),
        ("-2e5", -2e5),
        ("+1.5e-2", 1.5e-2),
        ("1.e1", 10.0),
        ("1.5", 1.5),
        (".5", 0.5),
        ("7", 7),
        ("-7", -7),
        (".inf", math.inf),
        ("-.inf", -math.inf),
        ("true", True),
        ("e3", "e3"),
        ("'1e-3'", "1e-3"),
        ("1e", "1e"),
        ("[1, 2.0, 1e2]", [1, 2.0, 100.0]),
    ],
)
def test_yaml_numbers_are_read_as_ros_reads_them(text, value):
    read = parse_yaml(text)
    assert read == value
    assert type(read) is type(value)
    if isinstance(value, list):
        assert [type(item) for item in read] == [type(item) for item in value]


@settings(max_examples=100)
@given(number=st.floats(allow_nan=False, allow_infinity=False))
def test_any_number_that_python_writes_is_read_from_yaml(number):
    read = parse_yaml(f"value: {number!r}")["value"]
    assert isinstance(read, float)
    assert np.float64(read).tobytes() == np.float64(number).tobytes()


def test_yaml_runs_no_code(folder):
    file = folder / "code.yaml"
    trace = folder / "trace"
    file.write_text(f"!!python/object/apply:os.mkdir ['{trace}']\n")
    with pytest.raises(FileError, match="not YAML"):
        read_yaml(file)
    assert not trace.exists()


def test_a_home_is_found_or_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert expanded("~/a.csv") == tmp_path / "a.csv"
    assert str(expanded("a~/~b")) == "a~/~b"
    with pytest.raises(FileError, match="'~nobody_has_this_name' is nobody's home"):
        expanded("~nobody_has_this_name/a.csv")
