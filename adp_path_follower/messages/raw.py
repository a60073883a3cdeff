"""Read paths, odometry and transforms out of their serialised bytes, and write what is sent.

Node and replay both read paths by this module, so that they follow the same path to the last bit. A
path of a hundred thousand poses takes milliseconds: where frame names are equally long, poses lie
at even distances and are read in one step. Odometry and what is sent, in every control step, are
read and written as the few numbers that count, in a tenth of rclpy's time.
"""

import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from adp_path_follower.core.geometry import FloatArray, yaw_of_quaternion

if TYPE_CHECKING:  # the process that prepares paths need not wait for it
    from adp_path_follower.core.driving.output import FollowerOutput

HEADER = 4  # bytes of encapsulation before the first field
STAMP = 8  # bytes
_PADDING = 7  # [bytes], the most behind the last field
_LITTLE_ENDIAN = b"\0\1\0\0"  # the encapsulation
_POSE = 56  # bytes: seven numbers
_TWIST = 48  # bytes: six numbers
_COVARIANCE = 288  # bytes: thirty-six numbers
_NANOSECONDS = 1_000_000_000
_DEEPEST = 50  # frames above another: wrong transforms may have them in a ring


class CdrError(ValueError):
    """Report bytes that are not a message of the given definition."""


def byte_order(raw: bytes) -> str:
    """Return the byte order of a serialised message; CdrError if it is none."""
    if len(raw) < HEADER or raw[0] != 0 or raw[1] not in (0, 1):
        raise CdrError("no CDR encapsulation")
    return "<" if raw[1] else ">"


def aligned(at: int, size: int) -> int:
    """Return the next place at a multiple of a size [bytes]."""
    return at + -(at - HEADER) % size


def numbers_at(form: str, raw: bytes, at: int) -> tuple[Any, ...]:
    """Return numbers of a form of `struct` at a place; CdrError if the message is too short."""
    try:
        return struct.unpack_from(form, raw, at)
    except struct.error:
        raise too_short() from None


def text_at(raw: bytes, at: int, order: str) -> tuple[str, int]:
    """Return a string, and where it ends; CdrError if the message is too short."""
    (size,) = numbers_at(f"{order}I", raw, at)
    end = at + 4 + size
    if end > len(raw):
        raise too_short()
    return raw[at + 4 : end].rstrip(b"\0").decode(errors="replace"), end


def too_short() -> CdrError:
    """Return the error of a message that ends before its last field."""
    return CdrError("the message is shorter than its fields")


def check_end(message: bytes, end: int) -> None:
    """Raise CdrError where the last field of a message ends elsewhere than the message itself."""
    if end > len(message):
        raise too_short()
    if len(message) - end > _PADDING:  # by another definition its numbers are others
        raise CdrError("the message is longer than its fields")


@dataclass(frozen=True)
class PathPoses:
    """The content of a path message."""

    frame: str  # frame of the path
    # x [m], y [m] and heading [rad] of each pose, shape (N, 3); the heading is NaN where the
    # orientation is none.
    poses: FloatArray


def read_path(raw: bytes) -> PathPoses:
    """Return the content of a serialised nav_msgs/Path; raise CdrError if it is none."""
    frame, at, order = _header(raw)
    at = aligned(at, 4)
    (count,) = numbers_at(f"{order}I", raw, at)
    return PathPoses(frame, _planar(_numbers(raw, at + 4, count, order)))


class OdometryNumbers(NamedTuple):
    """The motion of a robot in the plane, from an odometry message."""

    seconds: int  # stamp, whole seconds
    nanoseconds: int  # stamp, rest
    frame: str  # frame of the pose
    child_frame: str  # frame of the twist
    position: tuple[float, ...]  # x, y and z [m]
    quaternion: tuple[float, ...]  # x, y, z and w
    linear: float  # velocity forwards [m/s]
    angular: float  # velocity about the vertical [rad/s]


def read_odometry(raw: bytes) -> OdometryNumbers:
    """Return the content of a serialised nav_msgs/Odometry; raise CdrError if it is none."""
    frame, at, order = _header(raw)
    child_frame, at = text_at(raw, aligned(at, 4), order)
    at = aligned(at, 8)
    pose = numbers_at(f"{order}7d", raw, at)
    at += _POSE + _COVARIANCE
    twist = numbers_at(f"{order}6d", raw, at)
    seconds, nanoseconds = numbers_at(f"{order}iI", raw, HEADER)
    if at + _TWIST + _COVARIANCE > len(raw):
        raise too_short()
    return OdometryNumbers(
        seconds, nanoseconds, frame, child_frame, pose[:3], pose[3:], twist[0], twist[5]
    )


class Transform(NamedTuple):
    """The place of a frame in its parent, in the plane."""

    stamp: int  # time [ns]
    parent: str
    child: str
    pose: tuple[float, float, float]  # x [m], y [m], turn [rad]


def read_transforms(raw: bytes) -> list[Transform]:
    """Return the content of a serialised tf2_msgs/TFMessage; raise CdrError if it is none."""
    order = byte_order(raw)
    found, at = [], HEADER + 4
    (count,) = numbers_at(f"{order}I", raw, HEADER)
    for _ in range(count):
        at = aligned(at, 4)
        seconds, nanoseconds = numbers_at(f"{order}iI", raw, at)
        parent, at = text_at(raw, at + STAMP, order)
        child, at = text_at(raw, aligned(at, 4), order)
        x, y, _, *turn = numbers_at(f"{order}7d", raw, aligned(at, 8))
        at = aligned(at, 8) + _POSE
        pose = x, y, yaw_of_quaternion(*turn)
        found.append(Transform(seconds * _NANOSECONDS + nanoseconds, parent, child, pose))
    check_end(raw, at)
    return found


def way_between(
    parents: Mapping[str, str], source: str, target: str
) -> tuple[list[str], list[str], str] | None:
    """Return the frames below a shared one, from a source up and from it down to a target.

    The last of the three is that shared frame. Returns None where there is no way.
    """
    up, down = ([frame] for frame in (source, target))
    for found in (up, down):
        while (parent := parents.get(found[-1])) is not None and len(found) < _DEEPEST:
            found.append(parent)
    shared = next((frame for frame in up if frame in down), None)
    if shared is None:
        return None
    return up[: up.index(shared)], down[: down.index(shared)][::-1], shared


def stamped_numbers(
    time: int, frame: str, numbers: Iterable[float], child_frame: str | None = None
) -> bytes:
    """Return a serialised message: a header at a time [ns], perhaps a child frame, and numbers."""
    numbers = tuple(numbers)
    head = struct.pack("<iI", *divmod(time, _NANOSECONDS))
    for text in (frame,) if child_frame is None else (frame, child_frame):
        coded = text.encode() + b"\0"
        head += struct.pack(f"<{-len(head) % 4}xI{len(coded)}s", len(coded), coded)
    return _LITTLE_ENDIAN + head + struct.pack(f"<{-len(head) % 8}x{len(numbers)}d", *numbers)


def pose_numbers(pose: FloatArray) -> tuple[float, ...]:
    """Return a planar pose (3,) as the seven numbers of a geometry_msgs/Pose."""
    x, y, theta = pose.tolist()
    return (x, y, 0.0, 0.0, 0.0, math.sin(0.5 * theta), math.cos(0.5 * theta))


def twist_numbers(velocity: FloatArray) -> tuple[float, ...]:
    """Return [v, w] as the six numbers of a geometry_msgs/Twist."""
    v, w = velocity.tolist()
    return (v, 0.0, 0.0, 0.0, 0.0, w)


def text_message(text: str) -> bytes:
    """Return a serialised std_msgs/String."""
    coded = text.encode() + b"\0"
    return _LITTLE_ENDIAN + struct.pack(f"<I{len(coded)}s", len(coded), coded)


def array_message(labels: Iterable[str], values: Sequence[float]) -> bytes:
    """Return a serialised Float64MultiArray: one row, whose dimension's label names its values."""
    coded, count = ", ".join(labels).encode() + b"\0", len(values)
    head = struct.pack(f"<II{len(coded)}s", 1, len(coded), coded)
    head += struct.pack(f"<{-len(head) % 4}xIIII", count, count, 0, count)
    return _LITTLE_ENDIAN + head + struct.pack(f"<{-len(head) % 8}x{count}d", *values)


def step_message(
    topic: str, time: int, frame: str, output: "FollowerOutput", cost: float, labels: Iterable[str]
) -> bytes:
    """Return what one of `STEP_TOPICS` tells of a control step at a time [ns], serialised.

    The cost is J so far; the labels name the terms of the basis.
    """
    if topic == "target":
        return stamped_numbers(time, frame, pose_numbers(output.target_pose))
    if topic == "tracking_error":
        return stamped_numbers(time, frame, output.error.tolist())
    if topic in ("critic_weights", "actor_weights"):
        weights: FloatArray = getattr(output.weights, topic.removesuffix("_weights"))
        return array_message(labels, weights.tolist())
    value = cost if topic == "cost" else getattr(output, topic)
    return _LITTLE_ENDIAN + struct.pack("<d", float(value))


def frame_of(raw: bytes) -> str:
    """Return the frame of a serialised nav_msgs/Path, at once; raise CdrError if it is none."""
    return _header(raw)[0]


def is_empty(raw: bytes) -> bool:
    """Return whether a serialised nav_msgs/Path is sound and has no poses, at once."""
    if len(raw) > HEADER + STAMP + 8 + 1024:  # longer than any header
        return False
    try:
        return not len(read_path(raw).poses)
    except CdrError:
        return False


def _header(raw: bytes) -> tuple[str, int, str]:
    """Return the frame, where the header ends, and the byte order; CdrError without a header."""
    order = byte_order(raw)
    return *text_at(raw, HEADER + STAMP, order), order


def _numbers(raw: bytes, at: int, count: int, order: str) -> FloatArray:
    """Return the seven numbers of each pose, shape (count, 7), from where the first one starts."""
    if count * (STAMP + _POSE) > len(raw):  # a damaged count must not ask for memory
        raise CdrError("a sequence is longer than its message")
    if not count:
        return np.zeros((0, 7))
    places = _even_places(raw, at, count, order) if count > 1 else None
    if places is None:
        places = np.empty(count, dtype=np.int64)
        for number in range(count):
            _, end = text_at(raw, aligned(at, 4) + STAMP, order)
            places[number] = aligned(end, 8)
            at = int(places[number]) + _POSE
    check_end(raw, int(places[-1]) + _POSE)
    numbers = np.frombuffer(raw, f"{order}f8", (len(raw) - HEADER) // 8, HEADER)
    return numbers[(places[:, None] - HEADER) // 8 + np.arange(7)].astype(float)


def _even_places(raw: bytes, at: int, count: int, order: str) -> np.ndarray | None:
    """Return where the numbers lie if all frame names are as long as the first, else None."""
    first_length = aligned(at, 4) + STAMP
    _, end = text_at(raw, first_length, order)
    place = aligned(end, 8)
    # A pose ends at a multiple of 8, so all that follow lie like the second.
    following = place + _POSE + STAMP
    if following + 4 > len(raw):
        return None
    _, end = text_at(raw, following, order)
    step = aligned(end, 8) - place
    if place + (count - 1) * step + _POSE > len(raw):
        return None
    lengths = np.ndarray((count - 1,), f"{order}u4", raw, following, (step,))
    if not (lengths == lengths[0]).all():
        return None
    return place + step * np.arange(count)


def _planar(numbers: FloatArray) -> FloatArray:
    """Return x, y and heading of positions and quaternions (N, 7), shape (N, 3)."""
    x, y, z, w = numbers[:, 3:].T
    with np.errstate(all="ignore"):  # a damaged message may hold anything; no rotation gives NaN
        norm = x * x + y * y + z * z + w * w
        heading = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
        heading = np.where(np.isfinite(norm) & (norm > 1e-6), heading, np.nan)
    return np.column_stack([numbers[:, 0], numbers[:, 1], heading])
