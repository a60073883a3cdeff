"""Messages and bags that tests make."""

from __future__ import annotations

import math
from pathlib import Path as FilePath

import numpy as np
from rosbags.rosbag2 import CompressionFormat, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.bags.writer import BagWriter

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
SECOND = 1_000_000_000


def header(stamp: int, frame: str = "odom"):
    second, rest = divmod(stamp, SECOND)
    return TYPES["std_msgs/msg/Header"](TYPES["builtin_interfaces/msg/Time"](second, rest), frame)


def vector(x: float = 0.0, y: float = 0.0, z: float = 0.0):
    return TYPES["geometry_msgs/msg/Vector3"](x, y, z)


def pose(x: float, y: float, theta: float):
    return TYPES["geometry_msgs/msg/Pose"](
        TYPES["geometry_msgs/msg/Point"](x, y, 0.0),
        TYPES["geometry_msgs/msg/Quaternion"](
            0.0, 0.0, math.sin(0.5 * theta), math.cos(0.5 * theta)
        ),
    )


def odometry(stamp: int, x: float, y: float, theta: float, v=0.0, w=0.0, frame="odom"):
    twist = TYPES["geometry_msgs/msg/Twist"](vector(v), vector(z=w))
    return TYPES["nav_msgs/msg/Odometry"](
        header(stamp, frame),
        "base_link",
        TYPES["geometry_msgs/msg/PoseWithCovariance"](pose(x, y, theta), np.zeros(36)),
        TYPES["geometry_msgs/msg/TwistWithCovariance"](twist, np.zeros(36)),
    )


def twist(v: float, w: float):
    return TYPES["geometry_msgs/msg/Twist"](vector(v), vector(z=w))


def twist_stamped(stamp: int, v: float, w: float):
    return TYPES["geometry_msgs/msg/TwistStamped"](header(stamp, "base_link"), twist(v, w))


def array(values, label="a, b"):
    layout = TYPES["std_msgs/msg/MultiArrayLayout"](
        [TYPES["std_msgs/msg/MultiArrayDimension"](label, len(values), len(values))], 0
    )
    return TYPES["std_msgs/msg/Float64MultiArray"](layout, np.array(values, dtype=float))


def path_message(points, frame="odom"):
    """Return a path through x, y or x, y, theta of each point."""
    stamped = TYPES["geometry_msgs/msg/PoseStamped"]
    poses = [pose(*point, *[0.0] * (3 - len(point))) for point in points]
    return TYPES["nav_msgs/msg/Path"](
        header(0, frame), [stamped(header(0, frame), item) for item in poses]
    )


def transform(stamp: int, parent: str, child: str, x: float, y: float, theta: float):
    planar = pose(x, y, theta)
    moved = TYPES["geometry_msgs/msg/Transform"](vector(x, y), planar.orientation)
    item = TYPES["geometry_msgs/msg/TransformStamped"](header(stamp, parent), child, moved)
    return TYPES["tf2_msgs/msg/TFMessage"]([item])


def drive_along(poses, path, rate=50, stamps=None, speed=0.5, frame="odom", path_frame="odom"):
    """Return the messages of a robot at poses (N, 3), with a command for each.

    Args:
        poses: x, y, theta at an even rate.
        path: Points of the path.
        rate: Rate [Hz].
        stamps: Stamps of odometry and commands [ns], (N,); those of arrival if None.
        speed: v [m/s] of odometry and commands, a number or one for each.
        frame: Frame of the odometry.
        path_frame: Frame of the path.

    """
    arrivals = 1000 * SECOND + np.arange(len(poses)) * SECOND // rate
    stamps = arrivals if stamps is None else stamps
    speeds = np.broadcast_to(speed, len(poses)).tolist()
    messages = [("/path", 999 * SECOND, path_message(path, path_frame))]
    for now, stamp, place, v in zip(
        arrivals.tolist(), np.asarray(stamps).tolist(), np.asarray(poses).tolist(), speeds,
        strict=True,
    ):  # fmt: skip
        messages.append(("/odom", now, odometry(stamp, *place, v, frame=frame)))
        messages.append(("/cmd_vel", now + 2_000_000, twist_stamped(stamp, v, 0.1)))
    return messages


def text(content: str):
    return TYPES["std_msgs/msg/String"](content)


def raw(message) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def write_bag(directory: FilePath, messages) -> FilePath:
    """Write (topic, time, message) by the package's own writer."""
    writer = BagWriter(directory)
    topics: dict[str, int] = {}
    for topic, time, message in messages:
        if topic not in topics:
            topics[topic] = writer.add_topic(topic, message.__msgtype__)
        writer.write(topics[topic], raw(message), time, time)
    writer.close()
    return directory


def write_foreign(
    directory: FilePath, messages, storage=StoragePlugin.MCAP, compression=None
) -> FilePath:
    """Write (topic, time, message) as `ros2 bag record` does, by the rosbags library."""
    writer = Writer(directory, version=9, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, time, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, message.__msgtype__, typestore=STORE
                )
            writer.write(connections[topic], time, raw(message))
    return directory


def number(value: float):
    return TYPES["std_msgs/msg/Float64"](value)


def pose_stamped(stamp: int, x: float, y: float, theta: float):
    return TYPES["geometry_msgs/msg/PoseStamped"](header(stamp), pose(x, y, theta))


def error_stamped(stamp: int, s: float, y: float, theta: float):
    return TYPES["geometry_msgs/msg/Vector3Stamped"](header(stamp), vector(s, y, theta))


def diagnostics(stamp: int, state: str, level: int = 0, message: str = ""):
    status = TYPES["diagnostic_msgs/msg/DiagnosticStatus"]
    value = TYPES["diagnostic_msgs/msg/KeyValue"]
    entry = status(level, "/path_follower", message or state, "", [value("state", state)])
    return TYPES["diagnostic_msgs/msg/DiagnosticArray"](header(stamp), [entry])


LINE = path_message([(float(x), 0.0) for x in range(-2, 60)])


def drive_on_line(lateral, heading=0.0, duration=20.0, rate=100, commands=twist_stamped):
    """Return the messages of a robot that drives along the x axis at 0.5 m/s.

    Args:
        lateral: y [m] at a time [s].
        heading: Theta [rad], constant.
        duration: Time [s].
        rate: Rate of odometry and commands [Hz].
        commands: Makes the message of a command, which arrives 3 ms after its odometry.

    """
    messages = [("/path", 0, LINE)]
    for step in range(round(duration * rate) + 1):
        stamp = SECOND + step * SECOND // rate
        time = step / rate
        command = (0.5, 0.2 * (-1) ** step)
        messages.append(("/odom", stamp, odometry(stamp, 0.5 * time, lateral(time), heading)))
        message = commands(*command) if commands is twist else commands(stamp, *command)
        messages.append(("/cmd_vel", stamp + 3_000_000, message))
    return messages


def learner_run(duration=12.0, hostile=""):
    """Return a run of this controller, with all of its topics."""
    node = "/path_follower"
    settings = "settings:\n  desired_speed: {}\n"
    messages = [
        *drive_on_line(lambda time: 0.2 * math.exp(-time), duration=duration, rate=50),
        (f"{node}/configuration", 0, text(settings.format(0.5))),
        (f"{node}/configuration", 6 * SECOND, text(settings.format(0.4))),
        ("/diagnostics", 0, diagnostics(0, "waiting", 1, f"waiting: no path{hostile}")),
        ("/diagnostics", 2 * SECOND, diagnostics(0, "following")),
        ("/diagnostics", 8 * SECOND, diagnostics(0, "fault", 2, "fault: no odometry")),
        ("/diagnostics", 9 * SECOND, diagnostics(0, "following")),
    ]
    label = ", ".join([hostile or "w0", *(f"w{index}" for index in range(1, 14))])
    for step in range(round(duration * 50) + 1):
        stamp, time = SECOND + step * SECOND // 50, step / 50
        weights = np.arange(14) * math.exp(-0.1 * time)
        messages += [
            (f"{node}/target", stamp, pose_stamped(stamp, 0.5 * time, 0.0, 0.0)),
            (
                f"{node}/tracking_error",
                stamp,
                error_stamped(stamp, 0.0, 0.2 * math.exp(-time), 0.0),
            ),
            (f"{node}/critic_weights", stamp, array(weights, label)),
            (f"{node}/actor_weights", stamp, array(weights, label)),
            (f"{node}/bellman_error", stamp, number(0.1 * math.exp(-time))),
            (f"{node}/excitation", stamp, number(0.5 + 0.25 * math.sin(time))),
            (f"{node}/cost", stamp, number(time)),
        ]
    return sorted(messages, key=lambda item: item[1])
