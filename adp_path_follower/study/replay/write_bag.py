"""Writes the outcome of a replay as a bag, which is analysed like any other."""

import heapq
from collections.abc import Iterator, Mapping
from pathlib import Path as FilePath

from adp_path_follower.bags.reader import messages_of
from adp_path_follower.bags.writer import BagWriter
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.messages.raw import (
    pose_numbers,
    stamped_numbers,
    step_message,
    text_message,
    twist_numbers,
)
from adp_path_follower.messages.topics import NODE, PLAIN, SERIES, STEP_TOPICS, TYPES
from adp_path_follower.study.replay.replay import Replay

_NODE = f"/{NODE}"
_NOT_TOLD = ("ground_truth", "robot_model")  # by a replay, of the series that a bag may have
_KINDS = {
    f"{'' if key in PLAIN else _NODE}/{key}": kinds[0]
    for key, kinds in SERIES.items()
    if key not in _NOT_TOLD
}
_KINDS[f"{_NODE}/configuration"] = TYPES["configuration"][0]
# Topics of the recorded run that stay as they are.
_COPIED = ("odom", "path", "goal_path", "ground_truth", "initial_weights")
_TRANSFORMS = "tf2_msgs/msg/TFMessage"

# Arrival [ns], topic, serialised message.
_Entry = tuple[int, str, bytes]


def write_replay(
    found: Replay,
    source: FilePath,
    topics: Mapping[str, str],
    bag: FilePath,
    velocity: FloatArray | None = None,
) -> None:
    """Write a bag with the replay's commands and learner topics beside the recorded odometry.

    `topics` maps "odom", "path" and others to be copied to their topics in `source`; `velocity` is
    v, w at each step (N, 2) of a closed loop, whose odometry then replaces the recorded one. Raises
    FileError if `bag` exists or cannot be made.
    """
    gone = ("odom", "ground_truth") if velocity is not None else ()
    kinds = {topics[key]: TYPES[key][0] for key in _COPIED if key in topics and key not in gone}
    numbers: dict[str, int] = {}

    def wanted(topic: str, kind: str) -> bool:
        """Return whether a topic is copied; it is added before its first message is read."""
        known = kinds.get(topic) == kind or (kind == _TRANSFORMS and velocity is None)
        if known and topic not in numbers:
            numbers[topic] = writer.add_topic(topic, kind)
        return known

    writer = BagWriter(bag, {"replay_of": source.name}, chunked=True)
    for topic, kind in _KINDS.items():
        if topic != "/odom" or velocity is not None:
            numbers[topic] = writer.add_topic(topic, kind)
    recorded = messages_of(source, wanted)
    for arrival, topic, message in heapq.merge(recorded, _replayed(found, velocity)):
        writer.write(numbers[topic], message, arrival, arrival)
    writer.close()


def _replayed(found: Replay, velocity: FloatArray | None) -> Iterator[_Entry]:
    """Yield the messages that the nodes would have published, step by step."""
    said, arrival = dict(found.configurations), int(found.steps.arrival[0])
    labels = found.settings.learning.value_basis.labels
    for step, output in enumerate(found.outputs):
        arrival = max(arrival, int(found.steps.arrival[step]))
        stamp, pose = int(found.steps.stamp[step]), found.steps.pose[step]
        if step in said:
            yield arrival, f"{_NODE}/configuration", text_message(said[step])
        if velocity is not None:
            zeros = (0.0,) * 36  # the covariances
            motion = (*pose_numbers(pose), *zeros, *twist_numbers(velocity[step]), *zeros)
            yield arrival, "/odom", stamped_numbers(stamp, "odom", motion, "base_link")
        for topic, numbers in (
            ("/cmd_vel", twist_numbers(output.command)),
            (f"{_NODE}/measured_pose", pose),
            (f"{_NODE}/measured_motion", found.steps.motion[step]),
        ):
            yield arrival, topic, stamped_numbers(stamp, "odom", numbers)
        for name in STEP_TOPICS:
            told = step_message(name, stamp, "odom", output, float(found.cost[step]), labels)
            yield arrival, f"{_NODE}/{name}", told
