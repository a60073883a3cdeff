"""Layouts for RViz, Foxglove and PlotJuggler name what a run really holds.

How the tools name fields is theirs: Foxglove's message paths are /topic.field[0].field, and
PlotJuggler's ROS parser joins everything by slashes, but indices in brackets; it takes diagnostics
apart into /topic/name of the status/key.
"""

from __future__ import annotations

import json
import numbers
import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.resources import config_file

pytestmark = pytest.mark.nodes

RVIZ, FOXGLOVE, PLOTJUGGLER = (
    f"layouts/path_follower.{kind}" for kind in ("rviz", "foxglove.json", "plotjuggler.xml")
)
# As rviz_default_plugins describes its displays.
RVIZ_TYPES = {
    "rviz_default_plugins/Odometry": ("nav_msgs/msg/Odometry",),
    "rviz_default_plugins/Path": ("nav_msgs/msg/Path",),
    "rviz_default_plugins/Pose": ("geometry_msgs/msg/PoseStamped",),
}
SCENE_TYPES = ("nav_msgs/msg/Path", "geometry_msgs/msg/PoseStamped")  # of Foxglove's 3D panel
DIAGNOSTICS = ("diagnostic_msgs/msg/DiagnosticArray",)


@dataclass(frozen=True)
class Use:
    """Topics and fields that a layout takes from a run.

    Attributes:
        topic: The topic.
        fields: Way to a number in its messages; empty for the message as a whole.
        types: Types that the topic may have; empty for any.
        frame: Frame in which the message must be; empty for any.

    """

    topic: str
    fields: tuple[str | int, ...] = ()
    types: tuple[str, ...] = ()
    frame: str = ""


@dataclass(frozen=True)
class Bag:
    """The types of a bag's topics, and the last message of each; of diagnostics all in one."""

    types: dict[str, str]
    messages: dict[str, Any]


@pytest.fixture(scope="module")
def bag(recommended_run) -> Bag:
    """Return what the real nodes have just recorded."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types, messages = {}, {}
    with Reader(recommended_run) as reader:
        for connection, _, raw in reader.messages():
            types[connection.topic] = connection.msgtype
            message = store.deserialize_cdr(raw, connection.msgtype)
            if connection.msgtype in DIAGNOSTICS and connection.topic in messages:
                message.status += messages[connection.topic].status  # several nodes take turns
            messages[connection.topic] = message
    return Bag(types, messages)


# Names in the layouts


def rviz_uses(text: str, topics: Collection[str]) -> Iterator[Use]:
    """Yield what the displays of an RViz configuration take."""
    manager = yaml.safe_load(text)["Visualization Manager"]
    for display in manager["Displays"]:
        if "Topic" in display:
            types = RVIZ_TYPES[display["Class"]]
            yield Use(
                display["Topic"]["Value"], (), types, manager["Global Options"]["Fixed Frame"]
            )


def foxglove_uses(text: str, topics: Collection[str]) -> Iterator[Use]:
    """Yield what the panels of a Foxglove layout take."""
    for name, panel in json.loads(text)["configById"].items():
        kind = name.split("!")[0]
        if kind == "3D":
            for topic in panel["topics"]:
                yield Use(topic, (), SCENE_TYPES, panel["followTf"])
        elif kind == "Plot":
            for path in (*panel["paths"], *filter(None, [panel.get("xAxisPath")])):
                topic, fields = re.fullmatch(
                    r"([\w/]+)((?:\.\w+|\[\d+\])+)", path["value"]
                ).groups()
                yield Use(topic, _way(fields))
        else:
            assert kind == "DiagnosticSummary", f"what is in a panel {kind}?"
            yield Use(panel["topicToRender"], (), DIAGNOSTICS)


def plotjuggler_uses(text: str, topics: Collection[str]) -> Iterator[Use]:
    """Yield what the curves of a PlotJuggler layout take."""
    root = ElementTree.fromstring(text)  # noqa: S314  # our own file
    for curve in root.iter("curve"):
        names = [curve.get("curve_x"), curve.get("curve_y")]
        for name in names if curve.get("curve_x") else [curve.get("name")]:
            topic = max((t for t in topics if name.startswith(f"{t}/")), key=len, default="")
            if topic == "/diagnostics":
                status, key = name.removeprefix(f"{topic}/").rsplit("/", 1)
                yield Use(topic, (status, key), DIAGNOSTICS)
            else:
                yield Use(topic or name, _way(name.removeprefix(topic)) if topic else ())


def _way(text: str) -> tuple[str | int, ...]:
    """Return names and indices in a text like ".data[0]" or "/data[0]"."""
    parts = re.findall(r"[./](\w+)|\[(\d+)\]", text)
    return tuple(name or int(index) for name, index in parts)


USES: dict[str, Callable[[str, Collection[str]], Iterator[Use]]] = {
    RVIZ: rviz_uses,
    FOXGLOVE: foxglove_uses,
    PLOTJUGGLER: plotjuggler_uses,
}


# Whether the bag has it


def problems(layout: str, text: str, bag: Bag) -> list[str]:
    """Return what a layout names and the bag has not, in sentences."""
    found = [_problem(use, bag) for use in USES[layout](text, bag.types)]
    assert found, "a layout that shows nothing"
    return [problem for problem in found if problem]


def _problem(use: Use, bag: Bag) -> str:
    if use.topic not in bag.types:
        return f"no topic {use.topic}"
    kind, message = bag.types[use.topic], bag.messages[use.topic]
    if use.types and kind not in use.types:
        return f"{use.topic} is {kind}, not {' or '.join(use.types)}"
    if use.frame and message.header.frame_id != use.frame:
        return f"{use.topic} is in frame {message.header.frame_id}, not {use.frame}"
    if kind in DIAGNOSTICS and use.fields:
        status, key = use.fields
        known = key == "level" and status in {item.name for item in message.status}
        return "" if known else f"{use.topic} has no {status}/{key}"
    try:
        for step in use.fields:
            message = message[step] if isinstance(step, int) else getattr(message, step)
    except (AttributeError, IndexError, TypeError):
        return f"{use.topic} has no {use.fields}"
    number = not use.fields or isinstance(message, numbers.Real)
    return "" if number else f"{use.topic}: {use.fields} is no number"


@pytest.mark.parametrize("layout", USES)
def test_everything_that_a_layout_names_is_in_a_fresh_bag(bag, layout):
    assert problems(layout, config_file(layout).read_text(encoding="utf-8"), bag) == []


WRONG = [
    (RVIZ, "Value: /path_follower/target", "Value: /path_follower/goal", "no topic /path_foll"),
    (RVIZ, "plugins/Pose\n", "plugins/Odometry\n", "target is geometry_msgs/msg/PoseStamped, not"),
    (RVIZ, "Fixed Frame: odom", "Fixed Frame: map", "is in frame odom, not map"),
    (FOXGLOVE, '"/path":', '"/plan":', "no topic /plan"),
    (FOXGLOVE, '"/path":', '"/odom":', "/odom is nav_msgs/msg/Odometry, not"),
    (FOXGLOVE, '"followTf": "odom"', '"followTf": "map"', "is in frame odom, not map"),
    (FOXGLOVE, "/cost.data", "/costs.data", "no topic /path_follower/costs"),
    (FOXGLOVE, "error.vector.y", "error.vector.w", "tracking_error has no ('vector', 'w')"),
    (FOXGLOVE, "error.vector.y", "error.vector", "is no number"),
    (FOXGLOVE, "actor_weights.data[5]", "actor_weights.data[500]", "has no ('data', 500)"),
    (FOXGLOVE, "pose.pose.position.x", "pose.position.x", "/odom has no ('pose', 'position'"),
    (FOXGLOVE, '"/diagnostics"', '"/path_follower/cost"', "cost is std_msgs/msg/Float64, not"),
    (PLOTJUGGLER, "/cost/data", "/costs/data", "no topic /path_follower/costs/data"),
    (PLOTJUGGLER, 'curve_y="/odom/pose/', 'curve_y="/odom/', "/odom has no ('pose', 'position'"),
    (PLOTJUGGLER, "critic_weights/data[0]", "critic_weights/data[500]", "has no ('data', 500)"),
    (PLOTJUGGLER, "//path_follower/level", "//planner/level", "/diagnostics has no /planner/le"),
    (PLOTJUGGLER, "//path_follower/level", "//path_follower/state", "has no /path_follower/st"),
]


@pytest.mark.parametrize(("layout", "right", "wrong", "problem"), WRONG)
def test_a_wrong_name_is_found(bag, layout, right, wrong, problem):
    text = config_file(layout).read_text(encoding="utf-8")
    assert right in text
    assert any(problem in found for found in problems(layout, text.replace(right, wrong), bag))


@pytest.mark.parametrize("layout", [FOXGLOVE, PLOTJUGGLER])
def test_the_plots_show_the_run_at_a_glance(bag, layout):
    text = config_file(layout).read_text(encoding="utf-8")
    shown = {use.topic for use in USES[layout](text, bag.types)}
    learner = ("critic_weights", "actor_weights", "bellman_error", "excitation", "cost")
    names = ("target", "tracking_error", *learner)
    assert shown >= {"/odom", "/cmd_vel", "/diagnostics", *(f"/path_follower/{n}" for n in names)}


def test_every_foxglove_panel_has_its_place():
    layout = json.loads(config_file(FOXGLOVE).read_text(encoding="utf-8"))

    def panels(node: str | dict[str, Any]) -> list[str]:
        return [node] if isinstance(node, str) else panels(node["first"]) + panels(node["second"])

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
