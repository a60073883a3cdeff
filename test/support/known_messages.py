"""Messages that are known functions of their numbers, and the process that publishes them.

`python known_messages.py START` publishes at 100 Hz until it is ended. Each message carries its
number in its stamp: START [ns] + number * 10 ms.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry, Path
from rclpy.serialization import serialize_message
from rosbags.typesys import Stores, get_typestore
from std_msgs.msg import Float64MultiArray, Header, String

PERIOD = 10_000_000  # [ns]
_STORE = get_typestore(Stores.ROS2_JAZZY)


def _header(number: int, start: int) -> Header:
    header = Header(frame_id=f"frame_{number % 7}")
    header.stamp.sec, header.stamp.nanosec = divmod(start + number * PERIOD, 1_000_000_000)
    return header


def _odometry(number: int, start: int) -> Odometry:
    message = Odometry(header=_header(number, start))
    message.pose.pose.position.x = number / 3.0
    message.pose.covariance[number % 36] = 1.0 / (1 + number)
    return message


def _command(number: int, start: int) -> TwistStamped:
    message = TwistStamped(header=_header(number, start))
    message.twist.linear.x, message.twist.angular.z = 1.0 / (1 + number), number * 1e-3
    return message


def _weights(number: int, start: int) -> Float64MultiArray:
    return Float64MultiArray(data=[float(start), float(number), *([number / 7.0] * (number % 20))])


def _text(number: int, start: int) -> String:
    text = f"{start} {number} " + "äöü" * (number % 50)
    # DDS fills messages up to four bytes, so this one needs no filling: with its final zero.
    return String(data=text + "." * (-(len(text.encode()) + 1) % 4))


TOPICS: dict[str, tuple[type, Callable[[int, int], Any]]] = {
    "/odom": (Odometry, _odometry),
    "/ground_truth": (Odometry, _odometry),
    "/cmd_vel": (TwistStamped, _command),
    "/path_follower/critic_weights": (Float64MultiArray, _weights),
    "/known/text": (String, _text),
}
LATCHED: tuple[str, type] = ("/path", Path)


def known_bytes(topic: str, number: int, start: int) -> bytes:
    """Return a message as it is published.

    ROS leaves old memory in the gaps between fields; rosbags fills them with zeros.
    """
    kind, make = TOPICS[topic]
    name = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
    message = _STORE.deserialize_cdr(serialize_message(make(number, start)), name)
    return bytes(_STORE.serialize_cdr(message, name))


def main(start: int) -> None:
    """Publish until the process is ended; numbers go on, however late a round is."""
    import rclpy
    from rclpy.qos import DurabilityPolicy, QoSProfile

    rclpy.init()
    node = rclpy.create_node("known_messages")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    path = node.create_publisher(LATCHED[1], LATCHED[0], latched)
    path.publish(Path(header=_header(0, start)))
    publishers = {
        topic: node.create_publisher(kind, topic, 1000) for topic, (kind, _) in TOPICS.items()
    }
    number = 0
    due = time.monotonic()
    while True:
        for topic, publisher in publishers.items():
            publisher.publish(known_bytes(topic, number, start))
        number += 1
        due += PERIOD * 1e-9
        time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main(int(sys.argv[1]))
