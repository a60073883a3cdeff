"""Weights files that are none, or damaged: one sentence each, whatever they hold."""

from __future__ import annotations

import io
import os
import zipfile

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.learning import weights_file
from adp_path_follower.core.learning.weights_file import decode, encode, read_weights, write_weights
from adp_path_follower.core.path.library import named_path
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

SMALL = {"basis_degree": 4, "sample_count": 128, "samples_per_step": 128}


def sound_content():
    driver = Driver(build(Settings, SMALL))
    driver.follow(named_path("circle:0.7"))
    for step in range(5):
        driver.step(np.array([0.02, 0.2, 0.5]), step * 10_000_000)
    return encode(driver.follower.saved_weights())


SOUND = sound_content()
ARRAYS = dict(np.load(io.BytesIO(SOUND)))
HEAD = ARRAYS.pop("head").tobytes().decode()


def content_of(head=HEAD, **changes):
    content = io.BytesIO()
    np.savez(content, head=np.frombuffer(head.encode(), np.uint8), **{**ARRAYS, **changes})
    return content.getvalue()


def refusal_of(content):
    """Return the sentence that refuses a content, empty if it is taken; nothing else is raised."""
    try:
        decode(content, "weights file f")
    except FileError as refusal:
        text = str(refusal)
    else:
        return ""
    assert "\n" not in text
    assert text.startswith("weights file f ")
    assert "save it again" in text
    return text


def test_a_sound_content_is_taken():
    assert refusal_of(SOUND) == refusal_of(content_of()) == ""


@settings(max_examples=200)
@given(data=st.data())
def test_flipped_bytes_are_refused_or_change_nothing(data):
    content = bytearray(SOUND)
    places = st.integers(0, len(content) - 1)
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(places)] ^= data.draw(st.integers(1, 255))
    if not refusal_of(bytes(content)):  # a time stamp, or another field of the archive
        found, sound = decode(bytes(content), ""), decode(SOUND, "")
        assert found.settings == sound.settings
        np.testing.assert_array_equal(found.learned.critic, sound.learned.critic)
        np.testing.assert_array_equal(found.learned.actor, sound.learned.actor)


@settings(max_examples=60)
@given(count=st.integers(0, len(SOUND) - 1))
def test_half_a_file_is_refused(count):
    assert refusal_of(SOUND[:count])


@settings(max_examples=100)
@given(content=st.binary(max_size=300))
@example(b"")
@example(b"PK\x05\x06" + bytes(18))  # an archive without a member
def test_any_bytes_are_refused(content):
    assert "is no weights file, or is damaged" in refusal_of(content)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"critic": ARRAYS["critic"][:, 1:]}, "'critic' has the shape"),
        ({"actor": ARRAYS["actor"][:-1]}, "'actor' has the shape"),
        ({"actor": ARRAYS["actor"].astype("f4")}, "the type float32"),
        ({"knots": ARRAYS["knots"].astype(float)}, "'knots' has"),
        ({"knots": ARRAYS["knots"][::-1]}, "'knots' do not rise"),
        ({"knots": ARRAYS["knots"] + 10**13}, "'knots' do not rise"),
        ({"critic": ARRAYS["critic"] * np.nan}, "'critic' is not finite"),
        ({"actor": ARRAYS["actor"] + np.inf}, "'actor' is not finite"),
        ({"curvature": ARRAYS["curvature"] * np.nan}, "'curvature' is not finite"),
        ({"head": HEAD.replace("version: 1", "version: 2")}, "has version 2 of the format, but"),
        ({"head": HEAD.replace("version: 1", "version: new")}, "has version 'new'"),
        ({"head": HEAD.replace("format: adp", "format: other")}, "is no weights file"),
        ({"head": HEAD.replace("length: ", "length: -")}, "how long its path is"),
        ({"head": HEAD.replace("closed: true", "closed: 1")}, "what its path is"),
        ({"head": HEAD.replace("reach: ", "reach: -9")}, "what its path is"),
        ({"head": HEAD.replace("desired_speed: 0.5", "desired_speed: fast")}, "must be a number"),
        ({"head": HEAD.replace("desired_speed: 0.5", "speed: 0.5")}, "unknown setting 'speed'"),
        ({"head": HEAD.replace("  desired_speed: 0.5\n", "")}, "does not say which 'desired_speed"),
        ({"head": HEAD[: HEAD.index("settings:")]}, "names no settings"),
        ({"head": "{"}, "is no weights file, or is damaged"),
        ({"head": "[1, 2]"}, "is no weights file, or is damaged"),
    ],
)
def test_what_is_wrong_is_named(changes, told):
    assert told in refusal_of(content_of(**changes))


def test_pickles_are_not_read():
    content = content_of(critic=np.array([{"a": 1}], dtype=object))
    assert "is no weights file, or is damaged" in refusal_of(content)


def test_an_archive_that_unpacks_to_too_much_is_not_unpacked(monkeypatch):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("head", *ARRAYS):
            archive.writestr(f"{name}.npy", bytes(100_000))
    monkeypatch.setattr(weights_file, "_MOST_BYTES", 400_000)
    read = []
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *arguments: read.append(arguments))
    assert refusal_of(packed.getvalue())
    assert not read


@settings(max_examples=60)
@given(
    name=st.sampled_from([*ARRAYS]),
    array=st.one_of(
        st.lists(st.floats(), max_size=4).map(np.array),
        st.lists(st.integers(-(2**63), 2**63 - 1), max_size=4).map(np.array),
        st.text(max_size=4).map(np.array),
        st.integers(0, 3).map(lambda n: np.zeros((n,) * n)),
    ),
)
def test_any_other_array_is_refused(name, array):
    assert refusal_of(content_of(**{name: array}))


@settings(max_examples=150)
@given(text=st.text(max_size=30), place=st.integers(0, len(HEAD)))
def test_any_text_in_the_head_is_taken_or_refused(text, place):
    refusal_of(content_of(head=HEAD[:place] + text + HEAD[place:]))


# --- reading and writing ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda file: None, "No such file"),
        (lambda file: file.mkdir(), "directory"),
        (lambda file: file.write_bytes(b""), "is no weights file"),
    ],
)
def test_files_that_cannot_be_read_are_named(tmp_path, make, told):
    file = tmp_path / "weights.npz"
    make(file)
    with pytest.raises(FileError, match=told) as refusal:
        read_weights(file, build(Settings, {}))
    assert str(file) in str(refusal.value)


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    file = tmp_path / "weights.npz"
    with file.open("wb") as sparse:
        sparse.truncate(2**28 + 1)
    with pytest.raises(FileError, match="too large"):
        read_weights(file, build(Settings, {}))


def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    file = tmp_path / "weights.npz"
    write_weights(file, b"old")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FileError, match=r"No space left on device; set 'save_weights_to'"):
        write_weights(file, b"new")
    assert file.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["weights.npz"]


@pytest.mark.parametrize("name", ["none/weights.npz", "folder", "nul\0byte"])
def test_places_where_nothing_can_be_written_are_named(tmp_path, name):
    (tmp_path / "folder").mkdir()
    with pytest.raises(FileError, match="cannot be written"):
        write_weights(tmp_path / name, b"new")
