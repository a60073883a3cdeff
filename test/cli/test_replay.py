"""`adp replay` of bags that real nodes recorded, in lock-step and by the controller's own timer."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import groupby
from pathlib import Path as FilePath
from unittest.mock import Mock

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped
from rosbags.rosbag2 import Reader
from std_srvs.srv import Trigger

from adp_path_follower.bags.reader import read_run
from adp_path_follower.bags.writer import BagWriter
from adp_path_follower.core.driving.output import Counts
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.messages.configuration import configuration_text, parse_configuration
from adp_path_follower.study.replay import republish
from adp_path_follower.study.replay.replay import compare_weights, replay, rerun
from adp_path_follower.study.replay.republish import recorded_messages
from bag_messages import odometry, path_message, raw
from commands import adp

pytestmark = pytest.mark.nodes

STEPS = 501  # of the five seconds that `recommended_run` records


@pytest.fixture(scope="module")
def bag(recommended_run) -> FilePath:
    """Return the bag of a run in lock-step with the recommended settings."""
    return recommended_run


def adp_replay(folder: FilePath, *arguments: str, **environment: str):
    return subprocess.run(
        [sys.executable, "-m", "adp_path_follower.cli.main", "replay", *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=folder,
        env={**os.environ, **environment},
    )


def test_the_same_parameters_give_the_same_commands_and_weights(bag, tmp_path):
    done = adp("replay", str(bag), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [
        f"{STEPS} of {STEPS} commands are identical to the last bit",
        f"{2 * STEPS} of {2 * STEPS} sets of weights are, too",
    ]
    assert not list(tmp_path.iterdir())


def test_a_bag_that_begins_after_the_run_is_not_blamed_on_its_version(bag, tmp_path):
    """Path and configuration are latched: a late recorder has them, but not the learning before."""
    writer = BagWriter(tmp_path / "late")
    with Reader(bag) as reader:
        late = reader.start_time + (reader.end_time - reader.start_time) // 2
        topics: dict[str, int] = {}
        for connection, time, raw_message in reader.messages():
            name = connection.topic
            if time < late and name not in ("/path", "/path_follower/configuration"):
                continue
            if name not in topics:
                topics[name] = writer.add_topic(name, connection.msgtype)
            writer.write(topics[name], raw_message, max(time, late), time)
    writer.close()
    done = adp("replay", "late", cwd=tmp_path)
    assert done.returncode == 1
    assert "the bag begins after the run: the controller had driven before" in done.stdout
    assert "another version" not in done.stdout


@pytest.mark.smoke
def test_other_parameters_give_a_bag_and_a_report(bag, tmp_path):
    table, figure, out = tmp_path / "both.csv", tmp_path / "both.png", tmp_path / "out"
    done = adp_replay(
        *(tmp_path, str(bag), "--set", "max_angular_vel=0.2", "--out", str(out)),
        *("--csv", str(table), "--figure", str(figure)),
    )
    assert done.returncode == 0, done.stderr
    assert "first difference after" in done.stdout
    _, _, recorded, _, replayed = np.loadtxt(table, delimiter=",", skiprows=1).T
    assert np.abs(recorded).max() > 0.2
    assert np.abs(replayed).max() == pytest.approx(0.2)
    assert figure.stat().st_size > 5000
    assert (out / "report.html").stat().st_size > 1_000_000
    old, new = read_run(bag), read_run(out / "bag_replayed")
    assert np.array_equal(new.series["odom"].values, old.series["odom"].values)
    assert np.array_equal(new.series["cmd_vel"].values[:, 1], replayed)
    # The written bag is a run like any other, and replays to the last bit itself.
    again = replay(new)
    assert again.identical.all()
    assert compare_weights(new, again).identical.all()
    assert again.follower.settings.limits.max_angular_vel == 0.2


def test_in_a_closed_loop_the_motion_is_another(bag, tmp_path):
    changed = ("--set", "desired_speed=0.3", "--closed-loop", "--out", "out")
    done = adp("replay", str(bag), *changed, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    old, new = read_run(bag), read_run(tmp_path / "out" / "bag_replayed")
    first, second = old.series["odom"].values, new.series["odom"].values
    np.testing.assert_allclose(second[0, :3], first[0, :3], atol=1e-12)
    # Its last speed is v_des, but for what the curvature and the small errors ask for.
    assert second[-1, 3] == pytest.approx(0.3, abs=0.03)
    assert first[-1, 3] == pytest.approx(0.5, abs=0.05)


def test_in_a_closed_loop_the_same_parameters_give_the_same_run(bag):
    run = read_run(bag)
    found, velocity = rerun(run)
    assert len(found.outputs) == STEPS
    # The same but for the heading, which odometry carries as a quaternion.
    _, first = np.unique(run.series["odom"].stamp, return_index=True)
    odometry = run.series["odom"].values[first]
    np.testing.assert_allclose(found.steps.pose, odometry[:, :3], atol=1e-9)
    np.testing.assert_allclose(velocity, odometry[:, 3:], atol=1e-9)


@pytest.mark.parametrize("kind", [TwistStamped, Twist])
def test_a_run_by_timer_replays_through_all_that_changes(peer, start, tmp_path, kind):
    """Another path, other parameters and a reset of learning, all while the robot drives."""
    commands = peer.listen(kind, "cmd_vel")
    stamped = kind is TwistStamped
    controller = start("controller", enable_stamped_cmd_vel=stamped)
    recorder = start("recorder", output=str(tmp_path / "bag"))
    start("sim_unicycle", x=-0.3, y=0.2)
    publisher = start("path_publisher", path="line")

    def drive_on() -> None:
        count = len(commands)
        peer.until(lambda: len(commands) > count + 60, "sixty commands")

    heard = ("cmd_vel", "path", "path_follower/configuration", "path_follower/measured_pose")
    peer.until(
        lambda: all(f"recording /{topic}\n" in recorder.output() for topic in heard),
        "the recorder",
    )
    drive_on()
    assert peer.set_parameter("path_follower", "desired_speed", 0.4).successful
    drive_on()
    assert peer.set_parameter("path_publisher", "path", "circle:0.4").successful
    drive_on()
    assert peer.call(Trigger, "path_follower/reset_learning").success
    drive_on()
    for node in (publisher, controller, recorder):
        node.stop()
    run = read_run(tmp_path / "bag")
    assert len(run.paths) == 2
    changes = [parse_configuration(text) for _, text in run.configurations]
    # The last words are a stop; a busy machine may add some, each with a configuration. Where no
    # robot of 0.4 m/s was driven before, the values far from the path come on the way, with one.
    values = controller.output().count("the policy far from the path is ready")
    assert len(changes) == 4 + values + changes[-1].counts.stops > 4
    resets = [change.counts.learning_resets for change in changes]
    assert [key for key, _ in groupby(resets)] == [0, 1]
    speeds = [change.values["desired_speed"] for change in changes]
    assert [key for key, _ in groupby(speeds)] == [0.5, 0.4]
    found = replay(run)
    assert found.answered.sum() > 200
    assert found.identical[found.answered].all()
    weights_found = compare_weights(run, found)
    assert not weights_found.notes
    assert len(weights_found.identical) > 200
    assert weights_found.identical.all()
    # Not trivially so: without one of the changes it is another run.
    unchanged = replay(run, changes[0].settings)
    assert not unchanged.identical[unchanged.answered].all()


def test_a_live_controller_answers_the_odometry_of_a_bag(bag, peer, start, domain, tmp_path):
    settings = {"control_trigger": "odometry", "path_start": "beginning"}
    # A busy machine may be half a second late, which is no fault here.
    controller = start("controller", use_sim_time=True, odom_timeout=60.0, **settings)
    recorder = start("recorder", output=str(tmp_path / "bag"), use_sim_time=True)
    done = adp_replay(tmp_path, str(bag), "--republish", "--rate", "1", ROS_DOMAIN_ID=str(domain))
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("played ")
    for node in (controller, recorder):
        node.stop()
    old, new = read_run(bag), replay(read_run(tmp_path / "bag"))
    assert new.identical.all()
    # Odometry is taken as it comes, and a busy machine loses some: where the target is then depends
    # on what was lost, but the steps that there were went by the poses of the bag.
    stamps, first = np.unique(old.series["odom"].stamp, return_index=True)
    _, mine, theirs = np.intersect1d(stamps, new.steps.stamp, return_indices=True)
    assert len(mine) == len(new.steps.stamp) > 50
    assert np.array_equal(new.steps.pose[theirs], old.series["odom"].values[first[mine], :3])
    assert new.replayed.any(axis=1).all()


def test_messages_that_are_cut_are_not_played(tmp_path):
    writer = BagWriter(tmp_path / "bag")
    kinds = {"odom": "nav_msgs/msg/Odometry", "path": "nav_msgs/msg/Path"}
    topics = {key: writer.add_topic(f"/{key}", kind) for key, kind in kinds.items()}
    for step in range(1, 6):
        content = raw(odometry(step, 0.1 * step, 0.0, 0.0))
        writer.write(topics["odom"], content[:-100] if step in (1, 4) else content, step, step)
        if step == 2:
            path = raw(path_message([(0.0, 0.0), (1.0, 0.0)]))
            writer.write(topics["path"], path, step, step)
    writer.close()
    names = {key: f"/{key}" for key in kinds}
    messages, damaged = recorded_messages(tmp_path / "bag", names)
    assert damaged == 2
    assert [(time, key) for time, key, _ in messages] == [
        *((2, "path"), (2, "odom"), (3, "odom"), (5, "odom")),
    ]
    # A recorder that found the path late: it cannot have come after the first command to move.
    messages, _ = recorded_messages(tmp_path / "bag", names, begun=1)
    assert messages[0][1] == "path"
    with pytest.raises(AdpError, match="no odometry on /path that can be decoded"):
        recorded_messages(tmp_path / "bag", {"odom": "/path", "path": "/odom"})


def test_nothing_to_play_is_one_sentence(tmp_path):
    done = adp("replay", str(tmp_path / "none"))
    assert done.returncode == 2
    assert done.stderr == f"adp: bag {tmp_path / 'none'} does not exist\n"


def test_an_interrupted_player_is_exit_code_130(bag, tmp_path, monkeypatch):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(republish, "_Player", Mock(return_value=Mock(play=interrupted)))
    monkeypatch.setattr(republish, "rclpy", Mock())  # the test's own nodes stay
    done = adp("replay", str(bag), "--republish", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.strip()) == (130, "", "adp: interrupted")


def test_without_plotly_the_bag_of_a_replay_is_there_without_a_report(
    tmp_path, monkeypatch, capsys
):
    from adp_path_follower.cli import replay as command

    monkeypatch.setitem(sys.modules, "plotly", None)
    command._write_report(tmp_path / "bag", {"odom": "/odom"}, tmp_path / "new", False)
    said = capsys.readouterr().out
    assert said.startswith(f"In {tmp_path}: new/, without a report: the report needs Plotly: ")


def test_what_a_configuration_says_is_read_again():
    settings, path = load_settings(Settings, "path_follower"), lissajous()
    found = parse_configuration(configuration_text(settings, path, 12, Counts(3, 2, 1)))
    assert found.settings == settings
    assert (found.path_digest, found.after_step) == (path.digest(), 12)
    assert found.counts == Counts(learning_resets=3, restarts=2, stops=1)
