"""`adp analyze` of bags as people have them: a right number, or a sentence why there is none."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path as FilePath

import numpy as np
import pytest

from adp_path_follower.analysis.bag_analysis import BagAnalysis, analyse_bag
from bag_messages import (
    SECOND,
    drive_along,
    drive_on_line,
    learner_run,
    odometry,
    path_message,
    text,
    transform,
    twist,
    twist_stamped,
    write_bag,
)
from commands import adp

CORNERS = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.5), (0.5, 1.5), (0.5, 3.0)]
LENGTH = 6.5


def along(points, step=0.01):
    """Return poses on the straight lines between points, (N, 3)."""
    pieces = []
    for start, end in itertools.pairwise(np.asarray(points, dtype=float)[:, :2]):
        length = math.dist(start, end)
        share = np.arange(0.0, length - 1e-9, step)[:, None] / length
        heading = math.atan2(*(end - start)[::-1])
        place = start + share * (end - start)
        pieces.append(np.column_stack([place, np.full(len(place), heading)]))
    return np.concatenate(pieces)


def analysed(folder: FilePath, messages, names=None) -> BagAnalysis:
    messages = sorted(messages, key=lambda item: item[1])
    return analyse_bag(write_bag(folder / "bag", messages), names or {}, 1, None)


def assert_driven(found: BagAnalysis, length=LENGTH, duration=None):
    metrics = found.metrics
    assert metrics["distance"] == pytest.approx(length, rel=0.01)
    assert metrics["path_covered"] == pytest.approx(length, rel=0.01)
    assert metrics["duration"] == pytest.approx(duration or length / 0.5, rel=0.01)
    assert metrics["cross_track_rms"] < 0.001


# Paths as they were meant


def test_corners_driven_on_their_lines_have_no_error(tmp_path):
    found = analysed(tmp_path, drive_along(along(CORNERS), CORNERS))
    assert_driven(found)
    assert found.metrics["cross_track_max"] < 0.003


def test_a_lawnmower_with_corners(tmp_path):
    lanes = [(0.0, 0.0), (3.0, 0.0), (3.0, 0.5), (0.0, 0.5), (0.0, 1.0), (3.0, 1.0)]
    assert_driven(analysed(tmp_path, drive_along(along(lanes), lanes)), 10.0)


def test_a_path_that_is_driven_backwards(tmp_path):
    there = [(x, 0.0, 0.0) for x in np.arange(0.0, 2.01, 0.1)]
    back = [(x, 0.3 * (2.0 - x), 0.0) for x in np.arange(1.9, -0.01, -0.1)]
    poses = along([*there, *back])
    turned = len(along(there))
    poses[turned:, 2] += math.pi
    speed = np.where(np.arange(len(poses)) < turned, 0.5, -0.5)
    found = analysed(tmp_path, drive_along(poses, [*there, *back], speed=speed))
    assert_driven(found, 2.0 + 2.0 * math.hypot(1.0, 0.3), len(poses) / 50.0)
    assert found.metrics["heading_max"] < 0.5


def test_a_path_that_is_sent_again_without_what_is_driven_is_the_same_one(tmp_path):
    """As controllers send it that cut off the poses behind the robot, here ahead of it."""
    poses = along(CORNERS)
    messages = drive_along(poses, CORNERS)
    for row in range(20, len(poses), 50):
        left = CORNERS[int(np.searchsorted([0.0, 2.0, 3.5, 5.0], 0.01 * row)) :]
        if len(left) > 1:
            messages.append(("/path", 1000 * SECOND + row * SECOND // 50, path_message(left)))
    assert_driven(analysed(tmp_path, messages))


def test_a_drive_before_the_path_came_is_not_compared_with_it(tmp_path):
    poses = along(CORNERS)
    there = along([(-3.0, 2.0), (0.0, 2.0)])
    stamps = 970 * SECOND + np.arange(len(there)) * SECOND // 50
    earlier = [
        (topic, at - 30 * SECOND, message)
        for topic, at, message in drive_along(there, CORNERS, stamps=stamps)
        if topic != "/path"
    ]
    stands = [
        ("/odom", at, odometry(at, *poses[0]))
        for at in range(990 * SECOND, 1000 * SECOND, SECOND // 50)
    ]
    found = analysed(tmp_path, [*earlier, *stands, *drive_along(poses, CORNERS)])
    assert found.metrics["path_covered"] == pytest.approx(LENGTH, rel=0.01)
    assert found.metrics["cross_track_max"] < 0.003
    assert any("of a drive before the path came" in note for note in found.notes)


def test_a_robot_that_never_was_near_its_path_is_told_of(tmp_path):
    away = np.add(along(CORNERS), [30.0, 0.0, 0.0])
    notes = analysed(tmp_path, drive_along(away, CORNERS)).notes
    assert any("never nearer than 28.0 m to the path" in note for note in notes)


def test_a_path_of_a_file_stands_for_one_that_the_bag_has_not(tmp_path):
    messages = drive_along(along(CORNERS), CORNERS)[1:]
    file = tmp_path / "path.csv"
    file.write_text("x,y\n" + "".join(f"{x},{y}\n" for x, y in CORNERS))
    found = analysed(tmp_path, messages, {"path": str(file)})
    assert_driven(found)


# Frames

TURNED = (3.0, -1.0, 2.0)  # x, y, theta of odom in map


def in_map(poses, place=TURNED):
    x, y, turn = place
    cos, sin = math.cos(turn), math.sin(turn)
    px, py, heading = np.asarray(poses, dtype=float).T
    return np.column_stack([x + cos * px - sin * py, y + sin * px + cos * py, heading + turn])


def test_a_path_in_another_frame_is_compared_by_tf(tmp_path):
    """The transform drifts, as that of a localisation does."""
    poses = along(CORNERS)
    count = len(poses)
    places = [(3.0 + 0.001 * step, -1.0, 2.0) for step in range(count)]
    truth = np.concatenate(
        [in_map(pose[None], place) for pose, place in zip(poses, places, strict=True)]
    )
    messages = drive_along(poses, [tuple(pose) for pose in truth], path_frame="map")
    odom = [item for item in messages if item[0] == "/odom"]
    tf = [
        ("/tf", now - 1, transform(now, "map", "odom", *place))
        for (_, now, _), place in zip(odom, places, strict=True)
    ]
    found = analysed(tmp_path, [*messages, *tf])
    assert found.metrics["cross_track_max"] < 0.003
    assert found.metrics["distance"] == pytest.approx(LENGTH, rel=0.01)
    assert "the odometry was brought from frame 'odom' to 'map' by /tf" in found.notes
    assert (found.trust.path_frame, found.trust.odometry_frame) == ("map", "odom")


def test_a_static_transform_the_other_way_round(tmp_path):
    poses = along(CORNERS)
    path = [tuple(pose) for pose in in_map(poses)]
    messages = drive_along(poses, path, path_frame="map", frame="/odom")
    # map below odom: the inverse of TURNED
    x, y, turn = TURNED
    cos, sin = math.cos(turn), math.sin(turn)
    inverse = (-cos * x - sin * y, sin * x - cos * y, -turn)
    static = ("/tf_static", 0, transform(0, "odom", "map", *inverse))
    assert analysed(tmp_path, [static, *messages]).metrics["cross_track_max"] < 0.003


def test_without_a_transform_all_but_the_comparison_is_reported(tmp_path):
    messages = sorted(drive_along(along(CORNERS), CORNERS, path_frame="map"), key=lambda m: m[1])
    write_bag(tmp_path / "bag", messages)
    limits = ["distance>6.4", "command_rate>49", "cross_track_rms<9", "path_covered>0", "cost<9"]
    required = itertools.chain.from_iterable(("--require", limit) for limit in limits)
    done = adp("analyze", "bag", "--out", "out", *required, cwd=tmp_path)
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert done.returncode == 1
    assert [item["met"] for item in found["requirements"]] == [[True], [True], *[[False]] * 3]
    metrics = {name: value for name, value in found["bags"][0]["metrics"].items() if value}
    assert metrics["distance"] == pytest.approx(LENGTH, rel=0.01)
    assert metrics["duration"] == pytest.approx(LENGTH / 0.5, rel=0.01)
    assert not any(name.startswith(("cross", "heading", "steady", "path")) for name in metrics)
    assert "cross_track_rms is not known, hardly measured: 0 of 650 poses could be" in done.stderr
    assert (
        "nothing is compared with the path in frame 'map': the odometry is in 'odom', and the bag "
        "has no transform between them; record /tf and /tf_static, too, or name a path in 'odom' "
        "by --path"
    ) in done.stderr
    track = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    np.testing.assert_allclose(track[-1, 1:3], CORNERS[-1], atol=0.02)
    assert "were driven, not compared with the path" in (tmp_path / "out/report.html").read_text()


def test_only_poses_with_a_transform_are_compared(tmp_path):
    """The localisation is lost after a third; what odometry drifts by then is not known."""
    poses = along(CORNERS)
    third = len(poses) // 3
    messages = drive_along(poses, [tuple(pose) for pose in in_map(poses)], path_frame="map")
    tf = [
        ("/tf", now - 1, transform(now, "map", "odom", *TURNED))
        for topic, now, _ in messages[: 2 * third]
        if topic == "/odom"
    ]
    found = analysed(tmp_path, [*messages, *tf])
    assert found.metrics["cross_track_max"] < 0.003
    known = 0.5 * (third / 50.0 + 1.04)  # and a second beyond the last
    assert found.metrics["path_covered"] == pytest.approx(known, abs=0.02)
    assert found.metrics["distance"] == pytest.approx(LENGTH, rel=0.01)
    assert "poses could be compared with the path" in found.trust.doubt("cross_track_rms")
    assert not found.trust.doubt("distance")


# Stamps


def stamps_of(kind: str, count: int):
    """Return the stamps of messages at 50 Hz, whose arrivals begin at 1000 s."""
    number = np.arange(count)
    good = 1000 * SECOND + number * SECOND // 50
    return {
        "zero": np.zeros(count, dtype=np.int64),
        "equal": np.full(count, 12_345_678_901),
        "half alike": good // 40_000_000 * 40_000_000,
        "half zero": np.where(number % 2, good, 0),
        "first ones zero": np.where(number < 30, 0, good),
        "set back": np.where(number < count // 2, good - good[0], good - good[count // 2]),
        "from wall to simulated": np.where(number < count // 2, good, good - good[0]),
        "ahead": np.where(number < count // 2, good, good + 3600 * SECOND),
        "ahead by little": np.where(number < count // 2, good, good + 5 * SECOND),
        "of two clocks in turn": np.where(number % 2, good, good - good[0] + 5 * SECOND),
        "shaken": good + np.random.default_rng(3).integers(-50_000_000, 50_000_000, count),
    }[kind]


@pytest.mark.parametrize(
    ("kind", "note"),
    [
        ("zero", "have the stamp of another: arrival is used"),
        ("equal", "have the stamp of another: arrival is used"),
        ("half alike", "have the stamp of another: arrival is used"),
        ("half zero", "have no sound stamp: arrival is used"),
        ("first ones zero", "30 messages have no sound stamp: their arrival is used"),
        ("set back", "time is set -6.5 s, as by a simulator's reset"),
        ("from wall to simulated", "as by a simulator's reset"),
        ("ahead", "time is set +3600.0 s"),
        ("ahead by little", "time is set +5.0 s"),
        ("of two clocks in turn", "in another order than the motion: arrival is used"),
        ("shaken", "in another order than the motion: arrival is used"),
    ],
)
def test_stamps_that_are_of_no_use_are_replaced_and_named(tmp_path, kind, note):
    poses = along(CORNERS)
    found = analysed(tmp_path, drive_along(poses, CORNERS, stamps=stamps_of(kind, len(poses))))
    assert_driven(found)
    assert any(note in said for said in found.notes)
    assert found.trust.odometry_used == found.trust.odometry_total == len(poses)


def test_commands_of_another_clock(tmp_path):
    poses = along(CORNERS)
    messages = drive_along(poses, CORNERS, stamps=stamps_of("set back", len(poses)) // 2 * 2)
    odom = drive_along(poses, CORNERS, stamps=7 * SECOND + np.arange(len(poses)) * SECOND // 50)
    wall = [item for item in drive_along(poses, CORNERS) if item[0] == "/cmd_vel"]
    assert len(messages) == len(odom)
    found = analysed(tmp_path, [*(item for item in odom if item[0] != "/cmd_vel"), *wall])
    assert_driven(found)
    assert "/cmd_vel: stamped by another clock than the odometry: arrival is used" in found.notes


def test_odometry_of_a_clock_that_is_a_little_ahead(tmp_path):
    poses = along(CORNERS)
    stamps = 1000 * SECOND + np.arange(len(poses)) * SECOND // 50
    ahead = drive_along(poses, CORNERS, stamps=stamps + 3 * SECOND // 10)
    wall = [item for item in drive_along(poses, CORNERS) if item[0] == "/cmd_vel"]
    assert_driven(analysed(tmp_path, [*(item for item in ahead if item[0] != "/cmd_vel"), *wall]))


def test_messages_that_were_held_up_set_no_time(tmp_path):
    """Ten of the messages that came while the recorder hung are kept."""
    messages = drive_along(along(CORNERS), CORNERS)
    held = messages[401:421]
    late = [(topic, 1006 * SECOND + at // 1000, message) for topic, at, message in held]
    found = analysed(tmp_path, [*messages[:401], *late, *messages[603:]])
    assert_driven(found)
    assert not [note for note in found.notes if "time is set" in note]


def test_simulated_time_may_begin_at_zero(tmp_path):
    """A controller commands zero at once, long before there is a path."""
    poses = along(CORNERS)
    messages = drive_along(poses, CORNERS, stamps=8 * SECOND + np.arange(len(poses)) * SECOND // 50)
    first = [("/cmd_vel", 992 * SECOND, twist_stamped(0, 0.0, 0.0))]
    found = analysed(tmp_path, [*first, *messages])
    assert_driven(found)
    assert not [note for note in found.notes if "sound stamp" in note]


def test_messages_out_of_order_are_sorted_and_counted(tmp_path):
    poses = along(CORNERS)
    order = np.arange(len(poses))
    order[100:400] = order[100:400].reshape(-1, 3)[:, [2, 0, 1]].ravel()
    stamps = 1000 * SECOND + order * SECOND // 50
    found = analysed(tmp_path, drive_along(poses[order], CORNERS, stamps=stamps))
    assert_driven(found)
    assert "/odom: 200 messages are out of order: sorted by their stamps" in found.notes


def test_simulated_time_keeps_its_own_pace(tmp_path):
    poses = along(CORNERS)
    stamps = np.arange(len(poses)) * SECOND // 250
    assert_driven(
        analysed(tmp_path, drive_along(poses, CORNERS, stamps=stamps)), duration=LENGTH / 2.5
    )


# Distance


@pytest.mark.parametrize("noise", [0.003, 0.01])
def test_noise_adds_nothing_to_the_distance(tmp_path, noise):
    poses = along(CORNERS)
    poses[:, :2] += np.random.default_rng(1).normal(0.0, noise, (len(poses), 2))
    found = analysed(tmp_path, drive_along(poses, CORNERS))
    assert found.metrics["distance"] == pytest.approx(LENGTH, rel=0.01)


def test_a_noisy_robot_that_stands_drives_nowhere(tmp_path):
    poses = np.random.default_rng(1).normal(0.0, 0.01, (500, 3))
    found = analysed(tmp_path, drive_along(poses, CORNERS, speed=0.0))
    assert found.metrics["distance"] < 0.1


def test_a_jump_of_the_odometry_is_no_way(tmp_path):
    poses = along([(0.0, 0.0), (8.0, 0.0)])
    poses[400:, 0] += 2.0
    found = analysed(tmp_path, drive_along(poses, [(0.0, 0.0), (20.0, 0.0)]))
    assert_driven(found, 8.0)
    assert found.trust.jumps == 1


# The line of sanity


def test_odometry_that_ends_early_meets_no_requirement(tmp_path):
    messages = drive_on_line(lambda _: 0.0, duration=20.0, rate=20)
    messages = [item for item in messages if item[0] != "/odom" or item[1] < 5 * SECOND]
    write_bag(tmp_path / "bag", messages)
    limits = ("--require", "cross_track_rms<0.1", "--require", "command_rate>10")
    done = adp("analyze", "bag", "--out", "out", *limits, cwd=tmp_path)
    assert done.returncode == 1
    assert "hardly measured: the robot's place is known for 3.9 of 20.0 s only" in done.stderr
    content = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert [item["met"] for item in content["requirements"]] == [[False], [True]]
    trust = content["bags"][0]["trust"]
    assert trust["measured"] == pytest.approx(3.95, abs=0.11)
    assert trust["duration"] == pytest.approx(20.0)
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    for sentence in ("80 of 80 odometry messages and 401 of 401 commands used", "place known for"):
        assert sentence in done.stdout
        assert sentence in page


def test_the_cost_of_noise_is_compared_with_nothing(tmp_path):
    pytest.importorskip("casadi", reason="J* needs the extra 'optimum'")
    random = np.random.default_rng(1)
    messages = drive_on_line(lambda _: float(random.normal(0.0, 0.005)), duration=31.0, rate=10)
    settings = ("/path_follower/configuration", 0, text("settings:\n  desired_speed: 0.5\n"))
    found = analysed(tmp_path, [settings, *messages])
    assert math.isnan(found.metrics["cost_ratio"])
    assert any(note.startswith("no cost_ratio: J* is ") for note in found.notes)


# Side by side


def test_bags_with_topics_of_their_own_are_compared_by_one_cost(tmp_path):
    write_bag(tmp_path / "mine", learner_run())
    names = {"/path": "/plan", "/odom": "/base/odometry", "/cmd_vel": "/cmd_vel"}
    nav2 = drive_on_line(lambda _: 0.05, duration=31.0, rate=10, commands=twist)
    more = [
        ("/local_plan", 5, path_message([(0.0, 3.0), (9.0, 3.0)])),
        ("/other/odometry", 6, odometry(6, 3.0, 3.0, 0.0)),
    ]
    nav2 = sorted([*((names[t], now, m) for t, now, m in nav2), *more], key=lambda item: item[1])
    write_bag(tmp_path / "nav2", nav2)
    other = "nav2:path=/plan,odom=/base/odometry"
    done = adp("analyze", "mine", other, "--params", "default", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "out" / "metrics.json").read_text())
    mine, nav2 = (bag["metrics"] for bag in content["bags"])
    assert nav2["cross_track_max"] == pytest.approx(0.05, abs=1e-6)
    assert mine["cross_track_max"] == pytest.approx(0.2, abs=1e-6)
    assert "orange arrow is the optimum" not in (tmp_path / "out" / "report.html").read_text()
    assert nav2["cost"] > 30.0 * 0.05**2 * 0.99
