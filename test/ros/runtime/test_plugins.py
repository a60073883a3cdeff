"""A plugin in a folder of its own, in real nodes."""

import pytest
from std_msgs.msg import Float64MultiArray

from folders import ROOT
from live_nodes import Drive

pytestmark = pytest.mark.nodes


def test_a_node_drives_with_a_basis_and_a_far_policy_of_plugins(peer, start, tmp_path, monkeypatch):
    plugins = []
    for name in ("own_basis.py", "own_controller.py"):
        plugins.append(tmp_path / f"the_{name}")
        plugins[-1].write_text((ROOT / "examples" / name).read_text())
    monkeypatch.setenv("ADP_PLUGINS", ",".join(map(str, plugins)))
    parameters = tmp_path / "mine.yaml"
    parameters.write_text(
        "path_follower:\n  ros__parameters:\n    basis: bounded\n    wide_region: turn_first\n"
    )
    weights = peer.listen(Float64MultiArray, "path_follower/critic_weights")
    Drive(peer, lambda name: start(name, "--params-file", str(parameters)))
    peer.until(lambda: weights, "weights")
    assert len(weights[-1].data) == 8
    assert peer.set_parameter("path_follower", "wide_region", "riccati").successful
    assert peer.set_parameter("path_follower", "wide_region", "turn_first").successful


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("import no_such_module\n", "plugin '{file}' of ADP_PLUGINS: ModuleNotFoundError"),
        ("", "setting 'basis' is 'bounded', but must be one of paper,"),
    ],
)
def test_a_node_says_what_is_wrong_with_a_plugin_and_ends(start, tmp_path, monkeypatch, text, said):
    file = tmp_path / "mine.py"
    file.write_text(text)
    monkeypatch.setenv("ADP_PLUGINS", str(file))
    node = start("controller", basis="bounded")
    assert node.process.wait(60) == 2
    assert said.format(file=file) in node.output()
