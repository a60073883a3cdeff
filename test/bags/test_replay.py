"""Replays of bags that do not say all that this package's recordings say."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torn_bags
from commands import adp

from adp_path_follower.bags.reader import read_run
from adp_path_follower.bags.replay import replay, steps_of
from adp_path_follower.bags.replay_bag import write_replay
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.schema import update


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
    assert len(found.stamp) == len(steps_of(run).stamp)
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
    assert repeated.identical_weights(again).all()
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


# The command


def test_a_full_disk_is_one_sentence(bag, tmp_path):
    done = adp("replay", str(bag), "--csv", "/dev/full", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "adp: output /dev/full cannot be written: No space left on device\n"
