"""Bags to tear, ways to tear them, and what is in them, for the tests and the fuzz bench."""

from __future__ import annotations

import io
import random
import shutil
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path as FilePath

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.bags.writer import BagWriter
from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.geometry import yaw_of_quaternion
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import flatten, yaml_text

STORE = get_typestore(Stores.ROS2_JAZZY)
# Topic, times and bytes: what must be the same in a recovered bag.
Saved = tuple[str, int, int, bytes]

QOS = {
    "history": "keep_last",
    "depth": 10,
    "reliability": "reliable",
    "durability": "volatile",
    **{
        name: {"sec": 9223372036, "nsec": 854775807}
        for name in ("deadline", "lifespan", "liveliness_lease_duration")
    },
    "liveliness": "automatic",
    "avoid_ros_namespace_conventions": False,
}

_PERIOD = 10_000_000  # [ns]
LEARNER_KINDS = {
    "/path_follower/target": "geometry_msgs/msg/PoseStamped",
    "/path_follower/tracking_error": "geometry_msgs/msg/Vector3Stamped",
    "/path_follower/critic_weights": "std_msgs/msg/Float64MultiArray",
    "/path_follower/actor_weights": "std_msgs/msg/Float64MultiArray",
    "/path_follower/bellman_error": "std_msgs/msg/Float64",
    "/path_follower/excitation": "std_msgs/msg/Float64",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


def message(kind: str, *fields: object) -> bytes:
    """Return a serialised message."""
    return bytes(STORE.serialize_cdr(STORE.types[kind](*fields), kind))


def make(kind: str, *fields: object) -> object:
    return STORE.types[kind](*fields)


def _header(stamp: int) -> object:
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    time = make("builtin_interfaces/msg/Time", seconds, nanoseconds)
    return make("std_msgs/msg/Header", time, "odom")


def _pose(x: float, y: float, theta: float) -> object:
    return make(
        "geometry_msgs/msg/Pose",
        make("geometry_msgs/msg/Point", x, y, 0.0),
        make("geometry_msgs/msg/Quaternion", 0.0, 0.0, np.sin(theta / 2), np.cos(theta / 2)),
    )


def _twist(v: float, w: float) -> object:
    kind = "geometry_msgs/msg/Vector3"
    return make("geometry_msgs/msg/Twist", make(kind, v, 0.0, 0.0), make(kind, 0.0, 0.0, w))


def write_run(
    directory: FilePath, steps: int = 25, profiles: Sequence[dict] = (QOS,), learner: bool = False
) -> None:
    """Write the bag of a short run in lock-step, as the recorder does.

    Args:
        directory: The bag.
        steps: Control steps.
        profiles: QoS profiles of each topic.
        learner: Write the topics of the learner and /diagnostics, too.

    """
    settings = load_settings(
        Settings, "path_follower", None, ("control_trigger=odometry", "path_start=beginning")
    )
    points = lissajous().points(0.5)[:60, :2]
    path = Path.from_points(points)
    driver = Driver(settings)
    driver.follow(path)
    writer = BagWriter(directory, {"host": "here"})
    kinds = {
        "/path": "nav_msgs/msg/Path",
        "/path_follower/configuration": "std_msgs/msg/String",
        "/odom": "nav_msgs/msg/Odometry",
        "/cmd_vel": "geometry_msgs/msg/TwistStamped",
        "/path_follower/cost": "std_msgs/msg/Float64",
        **(LEARNER_KINDS if learner else {}),
    }
    topics = {name: writer.add_topic(name, kind, profiles) for name, kind in kinds.items()}

    def write(topic: str, stamp: int, *fields: object) -> None:
        writer.write(topics[topic], message(kinds[topic], *fields), stamp, stamp + 5)

    poses = [
        make("geometry_msgs/msg/PoseStamped", _header(0), _pose(float(x), float(y), 0.0))
        for x, y in points
    ]
    write("/path", 0, _header(0), poses)
    lines = [f"  {name}: {yaml_text(value)}" for name, value in flatten(settings).items()]
    write("/path_follower/configuration", 0, "settings:\n" + "\n".join(lines) + "\n")
    pose, (v, w) = np.array([-0.1, -0.1, 0.7]), (0.0, 0.0)
    for step in range(steps):
        stamp = (step + 1) * _PERIOD
        # The heading as it comes out of the message, so that a replay is the same to the last bit:
        # one that a quaternion gives back unchanged.
        for _ in range(5):
            half = pose[2] / 2
            pose[2] = yaw_of_quaternion(0.0, 0.0, np.sin(half), np.cos(half))
        covariance = np.full(36, 0.5 + step)
        write(
            *("/odom", stamp, _header(stamp), "base_link"),
            make("geometry_msgs/msg/PoseWithCovariance", _pose(*pose), covariance),
            make("geometry_msgs/msg/TwistWithCovariance", _twist(v, w), covariance),
        )
        v, w = driver.step(pose, stamp, np.array([v, w, 0.0])).command.tolist()
        write("/cmd_vel", stamp + 1, _header(stamp), _twist(v, w))
        write("/path_follower/cost", stamp + 2, 0.1 * (step + 1))
        for topic, fields in _learner_fields(stamp, pose, step) if learner else ():
            write(topic, stamp + 3, *fields)
        pose = pose + 0.01 * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), w])
    writer.close()


def _learner_fields(
    stamp: int, pose: np.ndarray, step: int
) -> Iterator[tuple[str, tuple[object, ...]]]:
    """Yield topic and fields of what the learner would publish; the numbers need not be right."""
    names = [f"w{index}" for index in range(14)]
    dimension = make("std_msgs/msg/MultiArrayDimension", ", ".join(names), 14, 14)
    weights = make("std_msgs/msg/MultiArrayLayout", [dimension], 0), np.arange(14.0) + step
    state = make("diagnostic_msgs/msg/KeyValue", "state", "following")
    status = make(
        *("diagnostic_msgs/msg/DiagnosticStatus", 0, "/path_follower", f"following {step // 20}"),
        *("", [state]),
    )
    error = make("geometry_msgs/msg/Vector3", 0.1, -0.1, 0.01 * step)
    yield "/path_follower/target", (_header(stamp), _pose(*pose))
    yield "/path_follower/tracking_error", (_header(stamp), error)
    yield "/path_follower/critic_weights", weights
    yield "/path_follower/actor_weights", weights
    yield "/path_follower/bellman_error", (0.1 / (1 + step),)
    yield "/path_follower/excitation", (0.2,)
    yield "/diagnostics", (_header(stamp), [status])


def contents(bag: FilePath) -> list[Saved]:
    """Return all messages in the files of a whole bag, in the order they were written."""
    found = []
    for file in sorted(bag.glob("*.mcap")) if bag.is_dir() else [bag]:
        channels: dict[int, str] = {}
        with file.open("rb") as stream:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Channel):
                    channels[record.id] = record.topic
                if isinstance(record, Message):
                    topic = channels[record.channel_id]
                    found.append((topic, record.log_time, record.publish_time, record.data))
    return found


def schemas(file: FilePath) -> dict[str, tuple[str, bytes]]:
    """Return the definitions in a whole file."""
    with file.open("rb") as stream:
        records = StreamReader(stream).records
        return {r.name: (r.encoding, r.data) for r in records if isinstance(r, Schema)}


def rewritten(file: FilePath, compression: CompressionType | None, chunk_size: int = 2000) -> bytes:
    """Return the same file in small chunks; without chunks if there is no compression."""
    output = io.BytesIO()
    chunks = {"use_chunking": False} if compression is None else {"compression": compression}
    writer = Writer(output, chunk_size=chunk_size, **chunks)
    writer.start(profile="ros2", library="test")
    with file.open("rb") as stream:
        for record in StreamReader(stream).records:
            if isinstance(record, Schema) and record.id not in writer._Writer__schemas:
                writer.register_schema(record.name, record.encoding, record.data)
            if isinstance(record, Channel) and record.id not in writer._Writer__channels:
                writer.register_channel(record.topic, "cdr", record.schema_id, record.metadata)
            if isinstance(record, Message):
                writer.add_message(
                    record.channel_id,
                    record.log_time,
                    record.data,
                    record.publish_time,
                    record.sequence,
                )
    writer.finish()
    return output.getvalue()


def boundaries(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, beginning and end of each record of a whole file."""
    offset = 8
    while offset < len(content) - 8:
        opcode, length = struct.unpack_from("<BQ", content, offset)
        yield opcode, offset, offset + 9 + length
        offset += 9 + length


def copy_with(bag: FilePath, target: FilePath, content: bytes) -> FilePath:
    """Copy a bag with another content of its file."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    shutil.copy(bag / "metadata.yaml", target)
    (target / f"{bag.name}_0.mcap").write_bytes(content)
    return target


def mutated(content: bytes, chance: random.Random) -> tuple[str, bytes]:
    """Return a way to damage a file, and the damaged file."""
    data = bytearray(content)
    ways = (
        *("cut", "bit flips", "swapped blocks", "wrong length", "huge length", "zeros"),
        *("noise", "trailing garbage", "empty", "removed block", "doubled block"),
    )
    way = chance.choice(ways)
    place, other = sorted(chance.randrange(len(data)) for _ in range(2))
    size = min(chance.choice((1, 16, 512, 4096, 20_000)), len(data) - place)
    if way == "cut":
        del data[place:]
    elif way == "bit flips":
        for _ in range(chance.choice((1, 3, 30, 300))):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    elif way == "swapped blocks":
        size = min(size, (len(data) - other), max(1, other - place))
        data[place : place + size], data[other : other + size] = (
            data[other : other + size],
            data[place : place + size],
        )
    elif way in ("wrong length", "huge length"):
        _, begin, end = chance.choice(list(boundaries(content)))
        lengths = (2**30, 2**40, 2**62, 2**63 - 1, 2**64 - 1, len(data))
        wrong = max(0, end - begin - 9 + chance.randint(-300, 300))
        struct.pack_into(
            "<Q", data, begin + 1, wrong if way == "wrong length" else chance.choice(lengths)
        )
        inner = min(begin + 9 + 2, len(data) - 4)  # a length within, as of a schema's name
        if chance.random() < 0.3:
            struct.pack_into("<I", data, inner, chance.choice((0, 2**31, 2**32 - 1)))
    elif way == "zeros":
        data[place : place + size] = bytes(size)
    elif way == "noise":
        data[place : place + size] = chance.randbytes(size)
    elif way == "trailing garbage":
        data += chance.choice((bytes(5000), chance.randbytes(5000), content[place:other]))
    elif way == "empty":
        data = data[: chance.choice((0, 0, 1, 8, 9))]
    elif way == "removed block":
        del data[place : place + size]
    elif way == "doubled block":
        data[other:other] = data[place : place + size]
    return way, bytes(data)


def message_ends(content: bytes) -> list[int]:
    """Return where the messages of a whole file without chunks end."""
    return [end for opcode, _, end in boundaries(content) if opcode == Opcode.MESSAGE]


def variants(run: FilePath) -> dict[str, bytes]:
    """Return the file of a run as several recorders would have written it."""
    file = run / f"{run.name}_0.mcap"
    return {
        "plain": file.read_bytes(),
        "chunks": rewritten(file, CompressionType.NONE),
        "lz4": rewritten(file, CompressionType.LZ4),
        "zstd": rewritten(file, CompressionType.ZSTD),
    }
