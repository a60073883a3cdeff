"""Replays of bags that do not say all that this package's recordings say."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from rosbags.rosbag2 import Reader

import torn_bags
from adp_path_follower.bags.reader import read_run
from adp_path_follower.bags.writer import BagWriter
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.settings.schema import update
from adp_path_follower.messages.configuration import parse_configuration
from adp_path_follower.study.replay.replay import compare_weights, replay, rerun, steps_of
from adp_path_follower.study.replay.write_bag import write_replay
from commands import adp


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("replay") / "run"
    torn_bags.write_run(folder)
    return folder


def test_another_controllers_bag_replays_with_parameters_that_are_given(bag):
    run = read_run(bag)
    settings = replay(run).follower.settings
    foreign = dataclasses.replace(run, configurations=())
    with pytest.raises(FileError, match="path_follower/configuration"):
        replay(foreign)
    assert replay(foreign, settings).identical.all()
    without = {key: series for key, series in run.series.items() if key != "cmd_vel"}
    silent = replay(dataclasses.replace(foreign, series=without), settings)
    assert not silent.answered.any()
    np.testing.assert_array_equal(silent.replayed, replay(run).replayed)


def test_commands_without_stamps_are_those_that_arrived_about_then(bag):
    run = read_run(bag)
    commands = run.series["cmd_vel"]
    plain = dataclasses.replace(commands, stamp=commands.arrival)
    found = replay(dataclasses.replace(run, series={**run.series, "cmd_vel": plain}))
    assert len(found.steps.stamp) == len(steps_of(run).stamp)
    assert found.identical.all()


def test_a_run_by_timer_without_its_poses_needs_parameters(bag):
    run = read_run(bag)
    (time, text), *_ = run.configurations
    by_timer = text.replace('control_trigger: "odometry"', 'control_trigger: "timer"')
    assert by_timer != text
    with pytest.raises(FileError, match="measured_pose"):
        replay(dataclasses.replace(run, configurations=((time, by_timer),)))


def test_the_bag_of_a_replay_is_a_run_like_any_other(bag, tmp_path):
    run = read_run(bag)
    settings = update(replay(run).follower.settings, {"target_gain": 0.7})
    found = replay(run, settings)
    assert not found.identical.all()
    write_replay(found, bag, run.topics, tmp_path / "again")
    again = read_run(tmp_path / "again")
    np.testing.assert_array_equal(again.series["odom"].values, run.series["odom"].values)
    np.testing.assert_array_equal(again.series["cmd_vel"].values, found.replayed)
    repeated = replay(again)
    assert repeated.identical.all()
    assert compare_weights(again, repeated).identical.all()
    assert repeated.follower.settings == settings


def test_poses_of_a_path_that_is_not_in_the_bag_are_refused(bag, tmp_path):
    run = read_run(bag)
    write_replay(replay(run), bag, run.topics, tmp_path / "again")
    again = read_run(tmp_path / "again")
    (time, text), *_ = again.configurations
    digest = text.split("digest: '")[1].split("'")[0]
    other = text.replace(digest, "0" * len(digest))
    with pytest.raises(FileError, match="has not the path 0000"):
        replay(dataclasses.replace(again, configurations=((time, other),)))


# Weights


@pytest.fixture(scope="module")
def learned(bag, tmp_path_factory):
    """Return a run with the weights of its own controller."""
    run, folder = read_run(bag), tmp_path_factory.mktemp("learned") / "run"
    write_replay(replay(run), bag, run.topics, folder)
    return read_run(folder)


def test_a_step_within_which_the_recording_ended_is_left_out(learned):
    motion = learned.series["measured_motion"]
    cut = dataclasses.replace(
        motion, stamp=motion.stamp[:-1], arrival=motion.arrival[:-1], values=motion.values[:-1]
    )
    found = replay(dataclasses.replace(learned, series={**learned.series, "measured_motion": cut}))
    assert len(found.steps.stamp) == len(motion.stamp) - 1
    assert found.identical[found.answered].all()


def with_critic(run, rows, values):
    """Return a run in which only some sets of critic weights were recorded, with these values."""
    series = run.series["critic_weights"]
    chosen = dataclasses.replace(
        series, stamp=series.stamp[rows], arrival=series.arrival[rows], values=values
    )
    return dataclasses.replace(run, series={**run.series, "critic_weights": chosen})


@pytest.mark.parametrize("rows", [np.arange(25), np.arange(0, 25, 5), np.arange(3, 25)])
def test_weights_that_differ_in_one_bit_are_found(learned, rows):
    """Whether each step has some, or fewer were recorded: by `debug_rate`, by a late recorder."""
    values = learned.series["critic_weights"].values[rows]
    found = replay(learned)
    same = compare_weights(with_critic(learned, rows, values), found)
    assert (same.difference, same.notes) == ("", ())
    assert len(same.identical) == len(rows) + 25
    changed = values.copy()
    changed[2, 4] = np.nextafter(values[2, 4], np.inf)
    other = compare_weights(with_critic(learned, rows, changed), found)
    assert np.flatnonzero(~other.identical).tolist() == [2]
    label, before, after = learned.series["critic_weights"].labels[4], changed[2, 4], values[2, 4]
    assert other.difference == (
        f"first difference of weights after {found.time[rows[2]]:.3f} s: critic weight {label} is "
        f"recorded as {before:.6g}, replayed as {after:.6g}, {before - after:.3g} apart"
    )


def test_weights_of_another_number_differ_and_too_many_are_not_compared(learned):
    series, found = learned.series["critic_weights"], replay(learned)
    fewer = compare_weights(with_critic(learned, np.arange(25), series.values[:, :3]), found)
    assert "number of critic weights is recorded as 3, replayed as" in fewer.difference
    rows = np.repeat(np.arange(25), 2)
    more = compare_weights(with_critic(learned, rows, series.values[rows]), found)
    assert not more.difference
    assert len(more.identical) == 25  # the actor's
    assert more.notes[0].startswith("the bag has 50 sets of critic weights for 25 steps")


# Parameters that changed during the run


@pytest.fixture(scope="module")
def slowed(learned):
    """Return the run as if its speed had been changed after the eleventh step."""
    (arrival, text), *_ = learned.configurations
    later = text.replace("desired_speed: 0.5", "desired_speed: 0.3")
    later = later.replace("after_step: -1", f"after_step: {steps_of(learned).stamp[10]}")
    return dataclasses.replace(
        learned, configurations=((arrival, text), (arrival + 100_000_000, later))
    )


def said(found):
    """Return for each configuration of a replay its step, speed and limit of the turn rate."""
    changes = [(step, parse_configuration(text).settings) for step, text in found.configurations]
    return [
        (step, settings.target.desired_speed, settings.limits.max_angular_vel)
        for step, settings in changes
    ]


def test_a_closed_loop_changes_parameters_when_they_changed(learned, slowed):
    before, _ = rerun(learned)
    found, _ = rerun(slowed)
    same = (before.replayed == found.replayed).all(axis=1)
    assert same.tolist() == [True] * 11 + [False] * 14
    limit = found.settings.limits.max_angular_vel
    assert said(found) == [(0, 0.5, limit), (11, 0.3, limit)]
    fixed, _ = rerun(slowed, found.settings)
    assert said(fixed) == [(0, 0.3, limit), (11, 0.3, limit)]


@pytest.mark.parametrize("closed_loop", [False, True])
def test_what_is_set_is_set_through_every_change(slowed, bag, tmp_path, closed_loop):
    overlay = {"max_angular_vel": 0.4}
    if closed_loop:
        found, velocity = rerun(slowed, None, overlay)
    else:
        found, velocity = replay(slowed, None, overlay), None
    assert said(found) == [(0, 0.5, 0.4), (11, 0.3, 0.4)]
    assert np.abs(found.replayed[:, 1]).max() == 0.4
    # The bag of it says so, too, and comes out the same.
    write_replay(found, bag, read_run(bag).topics, tmp_path / "again", velocity)
    again = read_run(tmp_path / "again")
    assert len(again.configurations) == 2
    repeated = replay(again)
    assert said(repeated) == said(found)
    np.testing.assert_array_equal(repeated.replayed, found.replayed)


# The command


def test_other_weights_are_exit_code_1(bag, tmp_path):
    run = read_run(bag)
    found = replay(run)
    outputs = list(found.outputs)
    for step in (10, 11):
        weights = outputs[step].weights
        critic = weights.critic + 0.001 * (np.arange(len(weights.critic)) == 2)
        outputs[step] = dataclasses.replace(
            outputs[step], weights=dataclasses.replace(weights, critic=critic)
        )
    write_replay(dataclasses.replace(found, outputs=outputs), bag, run.topics, tmp_path / "bag")
    done = adp("replay", "bag", cwd=tmp_path)
    assert done.returncode == 1
    commands, sets, difference, reason = done.stdout.splitlines()
    assert commands == "25 of 25 commands are identical to the last bit"
    assert sets == "48 of 50 sets of weights are, too"
    assert difference.startswith("first difference of weights after 0.100 s: critic weight ")
    assert difference.endswith(", 0.001 apart")
    assert "of another version, or was damaged" in reason


def renamed(source, directory, names):
    """Write a bag anew with other names of its topics; None leaves a topic out."""
    writer = BagWriter(directory)
    with Reader(source) as reader:
        kinds = {item.topic: item.msgtype for item in reader.connections}
        numbers = {
            topic: writer.add_topic(names.get(topic, topic), kind)
            for topic, kind in kinds.items()
            if names.get(topic, topic)
        }
        for connection, time, content in reader.messages():
            if connection.topic in numbers:
                writer.write(numbers[connection.topic], bytes(content), time, time)
    writer.close()
    return directory


@pytest.mark.parametrize("closed_loop", [False, True])
def test_topics_of_other_names_and_the_report_about_them(bag, tmp_path, closed_loop):
    pytest.importorskip("plotly", reason="the report needs the extra 'report'")
    names = {"/odom": "/filtered", "/cmd_vel": "/a/command", "/path": "/plan"}
    renamed(bag, tmp_path / "other", names)
    given = ("--odom", "filtered", "--cmd", "/a/command", "--path", "/plan")
    done = adp("replay", "other", *given, cwd=tmp_path)
    assert done.stdout.startswith("25 of 25 commands are identical"), done.stderr
    changed = ("--set", "target_gain=0.7", *(["--closed-loop"] if closed_loop else []))
    done = adp("replay", "other", *given, *changed, "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "report.html").exists()
    topics = set(read_run(tmp_path / "out" / "other_replayed").message_counts)
    assert topics >= {"/plan", "/cmd_vel", "/odom" if closed_loop else "/filtered"}


SETTINGS_MISSING = "the bag does not say with which settings a controller of this package ran"
PARAMETERS = ["--set", "target_gain=0.5"]


@pytest.mark.parametrize(
    ("missing", "options", "sentence"),
    [
        ("/path_follower/configuration", [], SETTINGS_MISSING),
        ("/path_follower/configuration", PARAMETERS, SETTINGS_MISSING),
        ("/path_follower/configuration", ["--closed-loop"], SETTINGS_MISSING),
        ("/path", [], "the bag has no path: name a topic of nav_msgs/msg/Path by --path"),
        ("/odom", [], "the bag has no odometry: name a topic of nav_msgs/msg/Odometry by --odom"),
    ],
)
def test_what_a_bag_lacks_is_said_with_what_helps(bag, tmp_path, missing, options, sentence):
    renamed(bag, tmp_path / "other", {missing: None})
    done = adp("replay", "other", *options, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith(f"adp: {sentence}")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        *(
            (["--republish", *option], f"settings of its own: not with {option[0]}")
            for option in (
                ["--closed-loop"],
                ["--params", "other.yaml"],
                ["--set", "target_gain=0.5"],
                ["--csv", "both.csv"],
                ["--figure", "both.png"],
                ["--out", "out"],
            )
        ),
        (["--rate", "2"], "without --republish nothing is played: not with --rate"),
        (["--closed-loop", "--csv", "both.csv"], "none to compare: not with --csv"),
        (["--closed-loop", "--figure", "both.png"], "none to compare: not with --figure"),
    ],
)
def test_options_that_would_do_nothing_are_refused(bag, tmp_path, options, sentence):
    done = adp("replay", str(bag), *options, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert sentence in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_one_sentence(bag, tmp_path):
    done = adp("replay", str(bag), "--csv", "/dev/full", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "adp: output /dev/full cannot be written: No space left on device\n"
    done = adp("replay", str(bag), *PARAMETERS, "--csv", "/dev/full", "--out", "out", cwd=tmp_path)
    assert done.returncode == 2
    assert not list(tmp_path.iterdir())
