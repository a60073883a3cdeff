"""Kill a recorder, recover its bag, and compare each message with what was published."""

from __future__ import annotations

import contextlib
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import Reader

import known_messages
from adp_path_follower.bags.recovery.recover import recover
from adp_path_follower.study.demo import NodeProcess

_READY = 60.0  # [s]


@dataclass(frozen=True)
class Kill:
    """How a recording was killed.

    Attributes:
        compression: Compression of the bag.
        max_duration: Time [s] after which the bag goes on in another file.
        after: Time [s] between the first message of every topic and the kill.

    """

    compression: str
    max_duration: float
    after: float


@dataclass(frozen=True)
class Outcome:
    """Messages that were saved of a recording.

    Attributes:
        messages: Number of messages saved.
        lost: Time [s] from the last message of the topic that ends first to the kill; of a topic
            without messages, from its first one, of which the recorder's log tells.
        problems: Differences to the published messages, in sentences.

    """

    messages: int
    lost: float
    problems: tuple[str, ...]


def random_kills(count: int, seed: int) -> list[Kill]:
    """Return kills at random moments: every other one of a packed, half of all of split bags."""
    chance = random.Random(seed)  # noqa: S311
    return [
        Kill(
            ("none", "zstd")[number % 2],
            (0.0, 1.0)[number // 2 % 2],
            chance.uniform(0.0, 2.5),
        )
        for number in range(count)
    ]


@contextlib.contextmanager
def published(domain: int, start: int) -> Iterator[None]:
    """Publish the known messages while the block runs; see `known_messages`."""
    process = subprocess.Popen(
        [sys.executable, known_messages.__file__, str(start)],
        env={
            **os.environ,
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        },
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield
    finally:
        ended = process.poll()
        process.kill()
        _, said = process.communicate()
        assert ended is None, f"the publisher ended early: {said}"


def kill_and_recover(kill: Kill, start: int, domain: int, folder: FilePath) -> Outcome:
    """Record what is published, kill the recorder with SIGKILL and recover the bag.

    Args:
        kill: How.
        start: Arguments of the publisher.
        domain: ROS domain of the publisher.
        folder: Where bags and logs go.

    """
    topics = (*known_messages.TOPICS, known_messages.LATCHED[0])
    bag = folder / "bag"
    settings = {
        "output": str(bag),
        "topics": topics,
        "compression": kill.compression,
        "max_duration": kill.max_duration,
    }
    recorder = NodeProcess("recorder", settings, log=folder / "recorder.log", domain=domain)
    try:
        for topic in topics:
            _wait_for_output(recorder, f"recording {topic}\n")
        time.sleep(kill.after)
    finally:
        killed_at = time.time_ns()
        recorder.stop(signal.SIGKILL)
    saved = recover(bag)
    return _judged(saved.bag, start, killed_at, _begun(recorder.output()))


def _wait_for_output(node: NodeProcess, text: str) -> None:
    """Wait until a node has printed a text."""
    end = time.monotonic() + _READY
    while text not in node.output():
        assert node.process.poll() is None, node.last_line()
        assert time.monotonic() < end, f"{node.name} did not say '{text}' in {_READY:g} s"
        time.sleep(0.02)


def _begun(log: str) -> dict[str, int]:
    """Return topic -> time [ns] of the message that the recorder got first."""
    found = re.findall(r"\[(\d+)\.(\d{9})\] \[recorder\]: recording (/\S+)\n", log)
    return {topic: int(seconds + fraction) for seconds, fraction, topic in found}


def _judged(bag: FilePath, start: int, killed_at: int, begun: dict[str, int]) -> Outcome:
    numbers: dict[str, list[int]] = {topic: [] for topic in known_messages.TOPICS}
    last = {topic: begun[topic] for topic in numbers}
    problems = []
    with Reader(bag) as reader:
        for connection, log_time, raw in reader.messages():
            topic = connection.topic
            if topic not in numbers:
                continue
            number = _number(topic, raw, start)
            if known_messages.known_bytes(topic, number, start) != raw:
                problems.append(f"{topic} {number} is not what was published")
            numbers[topic].append(number)
            last[topic] = log_time
    for topic, found in numbers.items():
        if found and found != list(range(found[0], found[0] + len(found))):
            problems.append(f"{topic} has gaps")
    lost = (killed_at - min(last.values())) * 1e-9
    return Outcome(sum(map(len, numbers.values())), lost, tuple(problems))


def _number(topic: str, raw: bytes, start: int) -> int:
    """Return the number of a message, as it says itself."""
    message: Any = deserialize_message(raw, known_messages.TOPICS[topic][0])
    if hasattr(message, "header"):
        stamp = message.header.stamp
        nanoseconds = stamp.sec * 1_000_000_000 + stamp.nanosec - start
        return int(nanoseconds // known_messages.PERIOD)
    if topic == "/known/text":
        return int(message.data.split(" ")[1])
    return int(message.data[1])
