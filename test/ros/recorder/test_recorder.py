"""The recorder as a process: what it records, how bags are named and split, and how it ends."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from pathlib import Path as FilePath
from typing import Any

import kills
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Goals, Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from std_msgs.msg import Float64, String
from std_srvs.srv import Trigger

from adp_path_follower.bags.recovery.recover import recover
from adp_path_follower.core.errors import SettingsError
from adp_path_follower.core.settings.schema import build
from adp_path_follower.ros.recorder.settings import (
    RecorderSettings,
    git_revision,
    is_meant,
    topic_patterns,
)
from adp_path_follower.study.demo import own_domain

pytestmark = pytest.mark.nodes

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def information(bag: FilePath) -> dict[str, Any]:
    content = yaml.safe_load((bag / "metadata.yaml").read_text(encoding="utf-8"))
    return content["rosbag2_bagfile_information"]


def recorded(bag: FilePath) -> dict[str, int]:
    """Return topic -> number of messages, counted."""
    counts: dict[str, int] = {}
    with AnyReader([bag]) as reader:
        for connection, _, _ in reader.messages():
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
    return counts


def publish_until(peer, recorder, publisher, message, text: str) -> None:
    """Publish again and again until the recorder prints a text."""

    def said() -> bool:
        publisher.publish(message)
        return text in recorder.output()

    peer.until(said, text)


def test_chosen_topics_of_any_type_and_late_ones_are_recorded(peer, start, tmp_path):
    bag = tmp_path / "bag"
    early = {
        "/robot/goals": (Goals, LATCHED),
        "/robot/secret": (String, LATCHED),
        "/other": (String, LATCHED),
        "/robot/event": (Trigger.Event, LATCHED),
    }
    for topic, (kind, qos) in early.items():
        peer.node.create_publisher(kind, topic, qos).publish(kind())
    recorder = start(
        "recorder",
        output=str(bag),
        topics=("odom", "/robot/.*", "num+er"),
        exclude=("robot/sec.*",),
    )
    peer.until(lambda: "recording /robot/goals\n" in recorder.output(), "goals")
    peer.until(lambda: "(std_srvs/srv/Trigger_Event) is not" in recorder.output(), "a warning")
    late = peer.node.create_publisher(Float64, "nummer", 10)
    publish_until(peer, recorder, late, Float64(data=1.0), "recording /nummer\n")
    publish_until(peer, recorder, peer.odometry, Odometry(), "recording /odom\n")
    assert recorder.stop() == 0
    assert set(recorded(bag)) == {"/robot/goals", "/nummer", "/odom"}
    assert recorder.output().count("is not recorded") == 1
    with AnyReader([bag]) as reader:
        (goals,) = (c for c in reader.connections if c.topic == "/robot/goals")
        assert "MSG: geometry_msgs/PoseStamped" in goals.msgdef.data
        messages = reader.messages([goals])
        assert reader.deserialize(next(messages)[2], "nav_msgs/msg/Goals").goals == []


def test_all_topics_but_those_excluded(peer, start, tmp_path):
    for topic in ("one", "deep/two", "three"):
        peer.node.create_publisher(String, topic, LATCHED).publish(String(data=topic))
    recorder = start(
        "recorder", output=str(tmp_path / "bag"), all=True, exclude=("three", ".*/p.*")
    )
    peer.until(lambda: "recording /one\n" in recorder.output(), "one")
    peer.until(lambda: "recording /deep/two\n" in recorder.output(), "two")
    recorder.stop()
    topics = {
        topic["topic_metadata"]["name"]
        for topic in information(tmp_path / "bag")["topics_with_message_count"]
    }
    assert {"/one", "/deep/two", "/diagnostics", "/rosout"} <= topics
    assert not {"/three", "/parameter_events"} & topics


def test_a_late_publisher_that_offers_less_is_recorded(peer, start, tmp_path):
    first = peer.node.create_publisher(String, "text", 10)
    recorder = start("recorder", output=str(tmp_path / "bag"), topics=("text",))
    publish_until(peer, recorder, first, String(data="reliable"), "recording /text\n")
    weak = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    second = peer.node.create_publisher(String, "text", weak)
    peer.until(second.get_subscription_count, "a subscription that takes best effort")
    for _ in range(20):
        second.publish(String(data="best effort"))
        peer.pause(0.02)
    recorder.stop()
    with AnyReader([tmp_path / "bag"]) as reader:
        raw = [bytes(raw) for _, _, raw in reader.messages()]
    assert any(b"best effort" in message for message in raw)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_loses_nothing(peer, start, tmp_path, number):
    bag = tmp_path / "bag"
    numbers = peer.node.create_publisher(Float64, "number", 4000)  # keeps all for a late reader
    recorder = start(
        "recorder", output=str(bag), topics=("number",), compression="zstd", max_size=100_000
    )
    publish_until(peer, recorder, numbers, Float64(data=-1.0), "recording /number\n")
    for index in range(3000):
        numbers.publish(Float64(data=float(index)))
        if index % 100 == 0:
            peer.pause(0.02)
    assert recorder.stop(number) == 0
    with AnyReader([bag]) as reader:
        values = [reader.deserialize(raw, c.msgtype).data for c, _, raw in reader.messages()]
    assert [value for value in values if value >= 0.0] == [float(index) for index in range(3000)]
    assert f"recorded {len(values)} messages to {bag}\n" in recorder.output()
    files = information(bag)["files"]
    assert sum(file["message_count"] for file in files) == len(values)
    assert not (bag / "reserve.tmp").exists()


def test_names_by_date_never_meet(peer, start, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    revision = "0123456789" * 4
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    (tmp_path / ".git" / "HEAD").write_text(f"{revision}\n")
    for seconds in range(90):
        taken = datetime.now() + timedelta(seconds=seconds)
        (tmp_path / taken.strftime("adp_run_%Y_%m_%d-%H_%M_%S")).mkdir()
    recorders = [start("recorder") for _ in range(2)]
    for recorder in recorders:
        peer.until(lambda node=recorder: "recording to " in node.output(), "a bag")
        recorder.stop()
    bags = [file.parent for file in tmp_path.glob("adp_run_*/metadata.yaml")]
    assert len(bags) == 2
    assert all("+" in bag.name for bag in bags)
    custom = information(bags[0])["custom_data"]
    assert custom["git_revision"] == revision
    assert {"host", "adp_path_follower", "python", "numpy", "rclpy"} <= set(custom)
    assert custom["recorder.compression"] == '"none"'
    assert all(isinstance(value, str) for value in custom.values())


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("topics", ("odom", "/a("), "setting 'topics' lists '/a(', which is no regular expression"),
        ("exclude", (), "a setting is an empty list, [], which ROS 2 does not pass on: leave it"),
        ("exclude", ("1odom",), "setting 'exclude' lists '1odom', which is no topic name"),
    ],
)
def test_wrong_topics_are_refused_in_one_sentence(start, tmp_path, name, value, expected):
    node = start("recorder", output=str(tmp_path / "bag"), **{name: value})
    assert node.process.wait(30.0) == 2
    assert expected in node.output()
    assert len(node.output().strip().splitlines()) == 1
    assert not (tmp_path / "bag").exists()


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"max_duration": 0.5}, "'max_duration' is 0.5, but must be 0 or at least 1"),
        ({"max_size": 1000}, "'max_size' is 1000, but must be 0 or at least 100000"),
        ({"max_size": -1}, "'max_size' is -1, but must be an integer, at least 0"),
        ({"compression": "lz4"}, "'compression' is 'lz4', but must be one of none, zstd"),
    ],
)
def test_wrong_settings_are_refused(values, expected):
    with pytest.raises(SettingsError) as raised:
        build(RecorderSettings, values)
    assert expected in str(raised.value)


@pytest.mark.parametrize(
    ("text", "topic", "expected"),
    [
        ("odom", "/robot/odom", True),
        ("odom", "/odom", False),
        ("/odom", "/odom", True),
        ("od.m", "/robot/odom", True),
        ("od.m", "/other/odom", False),
        (".*/odom", "/other/odom", True),
        ("odo.?", "/robot/odometry", False),
    ],
)
def test_names_and_expressions(text, topic, expected):
    def resolve(name: str) -> str:
        return name if name.startswith("/") else f"/robot/{name}"

    patterns = topic_patterns("topics", (text,), resolve)
    assert is_meant(patterns, topic, "/robot") is expected


def test_revisions_of_real_repositories(tmp_path):
    assert git_revision(FilePath("/")) == ""
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    assert git_revision(tmp_path) == ""
    identity = ("-c", "user.name=A", "-c", "user.email=a@example.org")

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    git("commit", "-q", "--allow-empty", "-m", "First")
    revision = git("rev-parse", "HEAD")
    (tmp_path / "deep" / "er").mkdir(parents=True)
    assert git_revision(tmp_path / "deep" / "er") == revision
    git("pack-refs", "--all")
    assert git_revision(tmp_path) == revision
    git("worktree", "add", "-q", str(tmp_path / "tree"))
    assert git_revision(tmp_path / "tree") == revision
    git("checkout", "-q", "--detach")
    assert git_revision(tmp_path) == revision
    (tmp_path / ".git" / "HEAD").write_bytes(b"\xff\xfe")
    assert git_revision(tmp_path) == ""


class Flood:
    """A publisher that fills a small disk soon, and what the recorder says about it."""

    def __init__(self, peer: Any) -> None:
        self.peer = peer
        self.publisher = peer.node.create_publisher(String, "flood", 10)
        self.diagnostics = peer.listen(DiagnosticArray, "/diagnostics")

    def statuses(self) -> list[DiagnosticStatus]:
        """Return what the recorder has said so far."""
        return [s for array in self.diagnostics for s in array.status if s.name == "/recorder"]

    def fill(self, recorder: Any) -> None:
        """Publish until the recorder gives up."""
        self.peer.until(self.statuses, "diagnostics")
        assert self.statuses()[0].level == DiagnosticStatus.OK
        publish_until(self.peer, recorder, self.publisher, String(data="x" * 30_000), "[ERROR]")
        count = len(self.statuses())
        self.peer.until(lambda: len(self.statuses()) > count + 1, "diagnostics after the end")

    def check(self, recorder: Any, bag: FilePath, cause: str) -> None:
        """Compare what the recorder said with what happened."""
        assert recorder.process.poll() is None
        assert recorder.output().count("[ERROR]") == 1
        assert f"recording to {bag} stopped: {cause}; " in recorder.output()
        last = self.statuses()[-1]
        values = {item.key: item.value for item in last.values}
        assert last.level == DiagnosticStatus.ERROR
        assert last.message == f"recording stopped: {cause}"
        assert values["bag"] == str(bag)
        assert values["cause"] == cause
        assert int(values["messages"]) > 10
        assert int(values["bytes"]) > 500_000
        assert recorder.stop() == 1


@pytest.fixture
def small_disk(tmp_path) -> Iterator[FilePath]:
    """Return a directory on a disk of 3 MiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "none", str(folder)],
        check=False,
        capture_output=True,
    )
    if mounted.returncode != 0:
        pytest.skip("only root can mount a small disk")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def test_on_a_full_disk_the_bag_is_closed_and_whole(peer, start, small_disk):
    flood = Flood(peer)
    bag = small_disk / "bag"
    recorder = start("recorder", output=str(bag), topics=("flood",))
    flood.fill(recorder)
    (count,) = recorded(bag).values()
    assert f"; all {count} messages up to then are in the bag; " in recorder.output()
    assert information(bag)["message_count"] == count > 50
    flood.check(recorder, bag, "No space left on device")


@pytest.fixture
def limited_start(start) -> Callable[..., Any]:
    """Start nodes whose files cannot grow beyond 2 MB: as on a disk without any room."""

    def starter(*arguments: Any, **parameters: Any) -> Any:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, hard))
        try:
            return start(*arguments, **parameters)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return starter


def test_without_any_room_the_bag_can_be_recovered_and_the_robot_drives_on(
    drive, limited_start, tmp_path
):
    flood = Flood(drive.peer)
    bag = tmp_path / "bag"
    recorder = limited_start("recorder", output=str(bag), topics=("flood", "cmd_vel"))
    drive.peer.until(lambda: "recording /cmd_vel\n" in recorder.output(), "commands")
    flood.fill(recorder)
    drive.until_moving()
    assert "`adp recover` reads what was written" in recorder.output()
    saved = recover(bag)
    assert saved.bytes_left == 0
    assert saved.message_counts["/flood"] > 50
    assert saved.message_counts["/cmd_vel"] >= 1
    flood.check(recorder, bag, "File too large")


def test_killed_recordings_are_recovered(tmp_path):
    """Two of the kills of bench/endurance/kills.py; what is lost is measured there."""
    for index, kill in enumerate(kills.random_kills(4, seed=7)[::3]):
        folder = tmp_path / str(index)
        folder.mkdir()
        start_time = time.time_ns()
        # Each on a domain of its own: shared memory of killed processes stays for some seconds.
        with own_domain() as domain, kills.published(domain, start_time):
            outcome = kills.kill_and_recover(kill, start_time, domain, folder)
        assert outcome.problems == ()
        assert os.listdir(folder / "bag_recovered")
