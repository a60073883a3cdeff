"""A dump by `ros2 param dump` of a running node starts an identical node."""

from __future__ import annotations

import math

import pytest
import yaml
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.parameter import parameter_value_to_python
from std_msgs.msg import String

from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.messages.configuration import parse_configuration
from adp_path_follower.ros.runtime.qos import ALL_CHANGES
from live_nodes import FRAMES, Peer

pytestmark = pytest.mark.nodes


def dump(peer: Peer, node: str) -> str:
    """Return what ros2cli's `ros2 param dump` prints: the same services, order and YAML."""
    names = sorted(peer.call(ListParameters, f"{node}/list_parameters").result.names)
    request = GetParameters.Request(names=names)
    values = peer.call(GetParameters, f"{node}/get_parameters", request).values
    parameters: dict[str, object] = {}
    for name, value in zip(names, values, strict=True):
        found = parameter_value_to_python(value)
        *groups, last = name.split(".")
        place = parameters
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = found.tolist() if hasattr(found, "tolist") else found
    return yaml.dump({node: {"ros__parameters": parameters}}, default_flow_style=False) + "\n"


def settings_told(messages) -> dict[str, object]:
    return dict(parse_configuration(messages[-1].data).values)


def test_a_dump_starts_an_identical_node(peer, start, tmp_path):
    name, space = "/robot_1/path_follower", ("-r", "__ns:=/robot_1")
    told = peer.listen(String, f"{name}/configuration", ALL_CHANGES)
    peer.path = peer.node.create_publisher(type(peer.send_path()), "/robot_1/path", ALL_CHANGES)
    first = start("controller", *space, min_linear_vel=-math.inf, basis_degree=5)
    changes = {
        "desired_speed": 1e-6,
        "max_linear_vel": 3,  # an integer for a number
        "max_angular_vel": math.inf,
        "state_cost": [1, 2, 3],
        "input_cost": [1.0, 0.25, 0.25, 1.5],
        "samples_per_axis": [2, 3, 3, 2],
        "learning": False,
        "save_weights_to": "yes: [no",
        "use_sim_time": False,
        "wide_region": "approach",  # the grid of values takes over when it is found
    }
    for key, value in changes.items():
        result = peer.set_parameter(name, key, value)
        assert result.successful, result.reason
    text = dump(peer, name)
    peer.send_path(frame=FRAMES[0])
    peer.until(lambda: told, "the configuration")
    expected = settings_told(told)
    assert expected["desired_speed"] == 1e-6
    assert first.stop() == 0
    file = tmp_path / "dump.yaml"
    file.write_text(text)
    told.clear()

    second = start("controller", *space, "--params-file", str(file))
    peer.until_matched(peer.path)
    peer.until(lambda: told, f"the configuration of {second.output()}")
    assert settings_told(told) == expected
    assert dump(peer, name) == text
    # `adp` reads it, too.
    assert (
        load_settings(Settings, "path_follower", file)
        == parse_configuration(told[-1].data).settings
    )
