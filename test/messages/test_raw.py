"""Odometry read out of its bytes, against the serialiser of rosbags."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.messages.raw import (
    CdrError,
    array_message,
    read_odometry,
    stamped_numbers,
    text_message,
)
from bag_messages import STORE, TYPES, array, text

NAMES = st.text("abcäß/_", max_size=9)
NUMBERS = st.lists(st.floats(), min_size=13, max_size=13)


def odometry_bytes(numbers, frame="odom", child_frame="base_link", little_endian=True) -> bytes:
    """Return odometry whose stamp is -3 s and 7 ns, of seven numbers of the pose and six more."""

    def made(name, *fields):
        return TYPES[name](*fields)

    stamp = made("builtin_interfaces/msg/Time", -3, 7)
    covariance = np.arange(36.0)
    pose = made(
        "geometry_msgs/msg/Pose",
        made("geometry_msgs/msg/Point", *numbers[:3]),
        made("geometry_msgs/msg/Quaternion", *numbers[3:7]),
    )
    twist = made(
        "geometry_msgs/msg/Twist",
        made("geometry_msgs/msg/Vector3", *numbers[7:10]),
        made("geometry_msgs/msg/Vector3", *numbers[10:]),
    )
    message = made(
        "nav_msgs/msg/Odometry",
        made("std_msgs/msg/Header", stamp, frame),
        child_frame,
        made("geometry_msgs/msg/PoseWithCovariance", pose, covariance),
        made("geometry_msgs/msg/TwistWithCovariance", twist, covariance),
    )
    return bytes(STORE.serialize_cdr(message, "nav_msgs/msg/Odometry", little_endian=little_endian))


@given(numbers=NUMBERS, frame=NAMES, child_frame=NAMES, little_endian=st.booleans())
def test_odometry_is_read_as_the_message_has_it(numbers, frame, child_frame, little_endian):
    found = read_odometry(odometry_bytes(numbers, frame, child_frame, little_endian))
    assert (found.seconds, found.nanoseconds) == (-3, 7)
    assert (found.frame, found.child_frame) == (frame, child_frame)
    # Every bit, also those of numbers that are none.
    read = [*found.position, *found.quaternion, found.linear, found.angular]
    np.testing.assert_array_equal(read, [*numbers[:7], numbers[7], numbers[12]])


@settings(max_examples=300)
@given(cut=st.integers(0, 750), place=st.integers(0, 749), value=st.integers(0, 255))
def test_damaged_odometry_is_refused_or_read_and_nothing_else(cut, place, value):
    raw = bytearray(odometry_bytes(np.arange(13.0).tolist()))
    raw[place % len(raw)] = value
    for damaged in (bytes(raw), bytes(raw[:cut])):
        try:
            found = read_odometry(damaged)
        except CdrError:
            continue
        assert len(found.position) + len(found.quaternion) == 7


def test_odometry_without_its_last_byte_is_refused():
    raw = odometry_bytes(np.arange(13.0).tolist())
    read_odometry(raw)
    with pytest.raises(CdrError, match="shorter than its fields"):
        read_odometry(raw[:-1])


def test_odometry_is_refused_wherever_it_is_cut_off():
    raw = odometry_bytes(np.arange(13.0).tolist())
    for length in range(len(raw)):
        with pytest.raises(CdrError):
            read_odometry(raw[:length])


@given(
    time=st.integers(-(2**31) * 1_000_000_000, 2**31 * 1_000_000_000 - 1),
    frame=NAMES,
    numbers=st.lists(st.floats(), min_size=6, max_size=6),
)
def test_a_header_and_numbers_are_written_as_the_serialiser_does(time, frame, numbers):
    made = TYPES["std_msgs/msg/Header"](
        TYPES["builtin_interfaces/msg/Time"](*divmod(time, 1_000_000_000)), frame
    )
    first, second = (
        TYPES["geometry_msgs/msg/Vector3"](*part) for part in (numbers[:3], numbers[3:])
    )
    vector = TYPES["geometry_msgs/msg/Vector3Stamped"](made, first)
    twist = TYPES["geometry_msgs/msg/TwistStamped"](
        made, TYPES["geometry_msgs/msg/Twist"](first, second)
    )
    for message, written in ((vector, numbers[:3]), (twist, numbers)):
        expected = STORE.serialize_cdr(message, message.__msgtype__)
        assert stamped_numbers(time, frame, written) == bytes(expected)


@settings(max_examples=100)
@given(
    labels=st.lists(NAMES, min_size=1, max_size=4),
    numbers=st.lists(st.floats(allow_nan=False), min_size=1, max_size=5),
    content=NAMES,
)
def test_texts_and_arrays_are_written_as_the_serialiser_does(labels, numbers, content):
    for message, written in (
        (text(content), text_message(content)),
        (array(numbers, ", ".join(labels)), array_message(labels, numbers)),
    ):
        assert written == bytes(STORE.serialize_cdr(message, message.__msgtype__))
