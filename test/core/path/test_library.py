"""Names and files of paths: what is accepted, and how the rest is refused."""

import contextlib

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from adp_path_follower.core.errors import AdpError, FileError, PathError
from adp_path_follower.core.path.library import (
    circle,
    named_path,
    named_points,
    named_route,
    path_from_file,
)
from adp_path_follower.core.path.preparation import prepare
from adp_path_follower.core.settings.groups import PathSettings

POINTS = [[0.0, 0.0], [1.0, 0.5], [2.0, 0.5], [3.0, 0.0]]


def written(folder, name, content):
    file = folder / name
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        file.write_text(content, encoding="utf-8")
    return file


# --- names --------------------------------------------------------------------------------------


def test_the_names_of_built_in_paths(figure_eight):
    assert named_path("lissajous").digest() == figure_eight.digest()
    assert not named_path("line").closed
    np.testing.assert_allclose(named_path("line").frame(7.0).pose, [7.0, 0.0, 0.0], atol=1e-12)
    slalom = named_path("identify")
    np.testing.assert_allclose(slalom.frame(slalom.length).pose, [12.0, 0.0, 0.0], atol=1e-3)
    bends = slalom.curvature(np.linspace(0.0, slalom.length, 500))
    assert 1.5 < bends.max() < 2.5
    assert -2.5 < bends.min() < -1.5
    assert named_path("circle:0.5").digest() == circle(0.5).digest()
    assert float(named_path("circle:-2e0").curvature(0.1)) == pytest.approx(-2.0, rel=1e-5)


@pytest.mark.parametrize(
    "name", ["", "lissajou", "Lissajous ", "circle", "line.txt", "/etc/passwd", "circle 0.5"]
)
def test_unknown_names_are_refused_with_the_known_ones(name):
    with pytest.raises(PathError) as caught:
        named_path(name)
    message = str(caught.value)
    assert f"'{name}'" in message
    assert "lissajous" in message
    assert "CSV" in message


@pytest.mark.parametrize(
    "curvature", ["0", "-0.0", "abc", "", "nan", "inf", "-inf", "1e-5", "2e4", "0.5,", "1e999"]
)
def test_circles_without_a_sound_curvature_are_refused(curvature):
    with pytest.raises(PathError) as caught:
        named_path(f"circle:{curvature}")
    message = str(caught.value)
    assert f"'{curvature}'" in message
    assert "circle:0.5" in message


@settings(max_examples=150)
@given(
    start=st.sampled_from(["", "circle:", "./", "missing/"]),
    text=st.text(max_size=12),
    end=st.sampled_from(["", ".csv", ".yaml", ".YML"]),
)
@example(start="", text="~", end=".csv")
@example(start="", text="\0", end=".csv")
@example(start="", text="a" * 5000, end=".yaml")
@example(start="", text="\ud800", end=".csv")
def test_any_text_names_a_path_or_is_refused(start, text, end):
    if start == "circle:":
        # Larger circles have many pieces: they are left to a test of their own.
        with contextlib.suppress(ValueError):
            assume(not 1e-4 <= abs(float(text + end)) < 0.05)
    try:
        path = named_path(start + text + end)
    except AdpError:
        return
    assert path.length > 0.0


# --- good files ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("plain.csv", "x,y\n0,0\n1,0.5\n2,0.5\n3,0\n"),
        ("columns.csv", "t,y,x\n9,0,0\n9,0.5,1\n9,0.5,2\n9,0,3\n"),
        ("spaced.csv", " X , Y \n 0 , 0\n1, 5e-1\n\n2,.5\n+3,-0\n"),
        ("bom.csv", b"\xef\xbb\xbfx,y\r\n0,0\r\n1,0.5\r\n2,0.5\r\n3,0\r\n"),
        ("quoted.csv", '"x","y"\n"0","0"\n1,0.5\n2,0.5\n3,0'),
        ("UPPER.CSV", "x,y\n0,0\n1,0.5\n2,0.5\n3,0\n"),
        ("decimal_comma.csv", "x;y\n0,0;0,0\n1;0,5\n2,000;0,5\n3;0\n"),
        ("tabs.csv", "n\tx\ty\n1\t0\t0\n2\t1\t0.5\n3\t2\t0.5\n4\t3\t0\n"),
        ("blanks.csv", "# x y\n 0   0\n 1   0.5\n 2  0.5 \n 3 0\n"),
        ("blank_lines.csv", "x,y\n0,0\n \n1,0.5\n2,0.5\n3,0\n  \n \n"),
        ("plain.yaml", "points: [[0, 0], [1, 0.5], [2, 0.5], [3, 0]]\n"),
        ("short.yml", "points:\n- [0.0, 0.0]\n- [1, 5e-1]\n- [2, 5E-1]\n- [3.0e+0, 0]\n"),
        ("headings.yaml", "points: [[0, 0, 9], [1, 0.5, 9], [2, 0.5, 9], [3, 0, 9]]\n"),
        ("open.yaml", "frame: odom\nclosed: false\npoints: [[0, 0], [1, .5], [2, .5], [3, 0]]\n"),
    ],
)
def test_good_files_give_the_path_through_their_points(tmp_path, name, content):
    file = written(tmp_path, name, content)
    expected = prepare(POINTS, PathSettings()).digest()
    assert path_from_file(file).digest() == expected
    assert named_path(str(file)).digest() == expected


def test_a_file_can_close_its_path(tmp_path):
    square = "points: [[0, 0], [2, 0], [2, 2], [0, 2]]\n"
    opened = path_from_file(written(tmp_path, "open.yaml", square))
    closed = path_from_file(written(tmp_path, "closed.yaml", square + "closed: true\n"))
    assert not opened.closed
    assert closed.closed
    np.testing.assert_allclose(
        closed.frame(closed.length).pose[:2], closed.frame(0.0).pose[:2], atol=1e-9
    )
    # Straight sides, rounded corners.
    assert closed.length == pytest.approx(8.0, rel=0.04)
    assert np.abs(closed.curvature(closed.length * (np.arange(4) + 0.5) / 4)).max() < 1e-6


def test_a_file_of_the_figure_eight_gives_the_figure_eight(tmp_path, figure_eight):
    rows = "\n".join(f"{x!r},{y!r}" for x, y, _ in figure_eight.points(0.05).tolist())
    path = named_path(str(written(tmp_path, "eight.csv", "x,y\n" + rows)))
    assert path.closed
    s = np.linspace(0.0, figure_eight.length, 3000)
    assert np.abs(path.curvature(s) - figure_eight.curvature(s)).max() < 5e-3


def test_headings_of_several_turns_are_no_degrees(tmp_path):
    turns = np.linspace(0.0, 6.0 * np.pi, 200)
    rows = np.column_stack([(1.0 + turns) * np.cos(turns), (1.0 + turns) * np.sin(turns)])
    headings = np.unwrap(np.arctan2(*np.diff(rows, axis=0).T[::-1]))
    lines = [f"{x},{y},{yaw}" for (x, y), yaw in zip(rows, headings, strict=False)]
    file = written(tmp_path, "spiral.csv", "x,y,yaw\n" + "\n".join(lines))
    assert named_route(str(file), PathSettings()).length > 50.0


def test_points_within_a_millimetre_are_no_closed_path():
    turns = np.linspace(0.0, 2.0 * np.pi, 60)
    for size in (5e-5, 4e-4):
        points = size * np.column_stack([np.cos(turns), np.sin(turns)])
        assert not prepare(points, PathSettings()).closed


# --- bad files ----------------------------------------------------------------------------------


BAD_FILES = [
    ("empty.csv", "", FileError, "empty"),
    ("blank.csv", " \n\t\n", FileError, "empty"),
    ("binary.csv", bytes(range(256)), FileError, "not text"),
    ("nul.csv", "x,y\n0,0\n1,\0\n", FileError, "NUL"),
    ("header.csv", "a,b\n0,0\n1,1\n", FileError, "'x'"),
    ("headless.csv", "0,0\n1,1\n", FileError, "'x'"),
    ("one_column.csv", "x\n0\n1\n", FileError, "'y'"),
    ("text.csv", "x,y\n0,0\n1,one\n", FileError, "line 3: '1,one'"),
    ("short.csv", "x,y\n0,0\n1\n", FileError, "line 3: '1'"),
    ("rowless.csv", "x,y\n", FileError, "no rows"),
    ("huge_field.csv", 'x,y\n"' + "0" * 200_000 + '",1\n', FileError, "CSV"),
    ("single.csv", "x,y\n0,0\n", PathError, "1 distinct points"),
    ("nan.csv", "x,y\n0,0\n1,nan\n", PathError, "point 1"),
    ("twice.csv", "x,x,y\n1,0,0\n1,1,0\n", FileError, "2 columns 'x'"),
    ("places.csv", "latitude,longitude\n52,13\n52.1,13\n", FileError, "to metres"),
    ("places_as_xy.csv", "x,y\n13.4,52.5\n13.40001,52.50002\n", FileError, "2e-05 m across"),
    ("degrees.csv", "x,y,yaw\n0,0,30\n1,0.577,30\n2,1.155,30\n", FileError, "yaw_deg"),
    ("empty.yaml", "", FileError, "empty"),
    ("comment.yaml", "# nothing\n", FileError, "empty"),
    ("binary.yaml", b"\xff\xfe\x00\x81", FileError, "not text"),
    ("nul.yaml", "points: \0", FileError, "NUL"),
    ("syntax.yaml", "points: [[0, 0], [1, 1\nclosed: true", FileError, "line 2"),
    ("tab.yaml", "points:\n\t- [0, 0]\n", FileError, "line 2"),
    ("tag.yaml", "points: !!python/object:os.system x", FileError, "YAML"),
    ("pointless.yaml", "waypoints: [[0, 0], [1, 1]]\n", FileError, "points"),
    ("list.yaml", "[[0, 0], [1, 1]]\n", FileError, "points"),
    ("words.yaml", "points: [[a, b], [c, d]]\n", FileError, "points"),
    ("ragged.yaml", "points: [[0, 0], [1]]\n", FileError, "points"),
    ("mapping.yaml", "points: {x: [0, 1], y: [0, 1]}\n", FileError, "points"),
    ("closed.yaml", "points: [[0, 0], [1, 1]]\nclosed: 7\n", FileError, "7"),
    ("none.yaml", "points: []\n", PathError, "shape"),
    ("null.yaml", "points:\n", PathError, "shape"),
    ("flat.yaml", "points: [0, 1, 2]\n", PathError, "shape"),
    ("nan.yaml", "points: [[0, 0], [.nan, 1]]\n", PathError, "point 1"),
    # PyYAML answers these with other exceptions than its own:
    ("date.yaml", "points: 2001-99-99\n", FileError, "YAML"),
    ("prefix.yaml", "points: 0x_\n", FileError, "YAML"),
    ("typed.yaml", "points: !!int ten\n", FileError, "YAML"),
    ("truth.yaml", "points: !!bool perhaps\n", FileError, "YAML"),
    ("moment.yaml", "points: !!timestamp now\n", FileError, "YAML"),
    ("long.yaml", f"points: [[{'9' * 5000}, 0], [1, 1]]\n", FileError, ""),
    ("large.yaml", f"points: [[{'9' * 400}, 0], [1, 1]]\n", AdpError, ""),
    ("deep.yaml", "[" * 500, FileError, "YAML"),
]


@pytest.mark.parametrize(
    ("name", "content", "kind", "words"), BAD_FILES, ids=[case[0] for case in BAD_FILES]
)
def test_bad_files_are_refused_by_name_and_cause(tmp_path, name, content, kind, words):
    file = written(tmp_path, name, content)
    with pytest.raises(kind) as caught:
        path_from_file(file)
    message = str(caught.value)
    assert str(file) in message
    assert words in message
    assert "\n" not in message
    assert len(message) < len(str(file)) + 200


@pytest.mark.parametrize("name", ["missing.csv", "missing.yaml", "none/such.yml"])
def test_missing_files_are_refused(tmp_path, name):
    with pytest.raises(FileError, match="No such file") as caught:
        named_path(str(tmp_path / name))
    assert name in str(caught.value)


@pytest.mark.parametrize("name", ["folder.csv", "folder.yaml"])
def test_a_folder_is_no_path_file(tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(FileError, match="directory") as caught:
        path_from_file(tmp_path / name)
    assert name in str(caught.value)


def test_files_are_published_as_they_are(tmp_path):
    square = "points: [[0, 0], [2, 0], [2, 2], [2, 2], [0, 2]]\nclosed: true\n"
    poses = named_points(str(written(tmp_path, "square.yaml", square)), 0.05)
    assert poses[:, :2].tolist() == [[0, 0], [2, 0], [2, 2], [0, 2], [0, 0]]
    assert np.isnan(poses[:, 2]).all()
    assert len(named_points("circle:1", 0.05)) > 100
    with pytest.raises(PathError, match="1 distinct"):
        named_points(str(written(tmp_path, "one.csv", "x,y\n1,1\n")), 0.05)
