"""A real node finds the values of the policy far from the path itself, and the run replays."""

from __future__ import annotations

import itertools
import os

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped

from adp_path_follower.bags.reader import read_run
from adp_path_follower.messages.configuration import parse_configuration
from adp_path_follower.study.replay.replay import replay

pytestmark = pytest.mark.nodes

READY = "the policy far from the path is ready, after "
FINDING = 300.0  # [s]; alone it takes ten


def test_a_node_finds_its_policy_far_from_the_path_while_it_drives(
    peer, start, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    commands = peer.listen(TwistStamped, "cmd_vel")
    controller = start("controller", controller_frequency=50.0)
    recorder = start("recorder", output=str(tmp_path / "bag"))
    heard = "recording /path_follower/status\n"
    peer.until(lambda: heard in recorder.output(), "a recorder")
    peer.until_matched(peer.odometry, peer.path)
    peer.node.create_timer(0.02, lambda: peer.send_odometry((0.0, 2.0, -1.0)))
    peer.send_path()
    peer.until(lambda: READY in controller.output(), "the values", FINDING)
    count = len(commands)
    peer.until(lambda: len(commands) > count + 100, "commands by the values")
    for node in (controller, recorder):
        node.stop()
    assert controller.output().count(READY) == 1
    assert "learning has gone wrong" not in controller.output()
    assert len(os.listdir(tmp_path / "cache" / "adp_path_follower")) == 1

    run = read_run(tmp_path / "bag")
    changes = [parse_configuration(text).values["wide_region"] for _, text in run.configurations]
    assert [kind for kind, _ in itertools.groupby(changes)] == ["approach", "value_grid"]
    again = replay(run)
    moving = again.answered & again.replayed.any(axis=1)
    assert again.identical[moving].all()
    stamps, driven = again.steps.stamp[moving], again.replayed[moving]
    assert (driven >= [0.0, -1.5]).all()
    assert (driven <= [1.0, 1.5]).all()
    # It changes within a second, by no more than from limit to limit.
    rates = np.abs(np.diff(driven, axis=0)) / np.maximum(np.diff(stamps) * 1e-9, 0.02)[:, None]
    assert rates.max() < 5.0
    assert np.abs(driven[-1] - driven[0]).max() > 0.1  # another policy
