"""A robot far from the path: the value function is found beside it, and a replay goes along."""

import pytest

from adp_path_follower.bags.reader import read_run
from adp_path_follower.study.replay.replay import replay

pytestmark = pytest.mark.nodes


def test_the_value_function_takes_over_while_driving_and_replays(
    peer, start, tmp_path, monkeypatch
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    controller = start("controller", learning=False)
    recorder = start("recorder", output=str(tmp_path / "bag"))
    # Facing away from a line that it is 30 m beside, it is far off until the value is there.
    start("sim_unicycle", y=30.0, theta=2.0)
    peer.until_matched(peer.path)
    peer.until(lambda: "recording /cmd_vel\n" in recorder.output(), "a recorder")
    start("path_publisher", path="line")
    peer.until(lambda: "value function is found" in controller.output(), "the search")
    peer.until(lambda: "found the value function" in controller.output(), "the value", 120.0)
    peer.pause(1.0)
    for node in (controller, recorder):
        node.stop()
    run = read_run(tmp_path / "bag")
    told = [text for _, text in run.configurations]
    assert any('wide_region: "approach"' in text for text in told)
    assert 'wide_region: "value_grid"' in told[-1]
    again = replay(run)
    assert again.answered.sum() > 200
    assert again.identical[again.answered].all()
