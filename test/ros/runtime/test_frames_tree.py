"""Where frames are in a tree of transforms, against matrices, and tf2 itself where it is."""

from __future__ import annotations

import importlib.util
import math

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from adp_path_follower.ros.runtime.path_frame import FrameError, Frames
from bag_messages import TYPES, transform

NAMES = [f"frame_{number}" for number in range(12)]
KIND = "tf2_msgs/msg/TFMessage"


def matrix(x: float, y: float, turn: float) -> np.ndarray:
    cos, sin = math.cos(turn), math.sin(turn)
    return np.array([[cos, -sin, x], [sin, cos, y], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("seed", range(5))
def test_a_frame_is_where_the_product_of_matrices_has_it(interfaces, peer, seed):
    chance = np.random.default_rng(seed)
    frames = Frames(peer.node)
    with pytest.raises(FrameError):
        frames.place(NAMES[0], NAMES[1])
    world, edges = {NAMES[0]: np.eye(3)}, []
    for number in range(1, 10):  # the others are not connected
        parent, child = NAMES[chance.integers(number)], NAMES[number]
        place = chance.uniform([-50.0, -50.0, -3.0], [50.0, 50.0, 3.0]).tolist()
        world[child] = world[parent] @ matrix(*place)
        edges.append(transform(number, parent, child, *place).transforms[0])
    raw = get_typestore(Stores.ROS2_JAZZY).serialize_cdr(TYPES[KIND](edges), KIND)
    frames._take(False, bytes(raw))
    for frame in NAMES:
        for within in NAMES:
            if frame != within and not {frame, within} <= {*world}:
                with pytest.raises(FrameError):
                    frames.place(frame, within)
                continue
            found = frames.place(frame, within).pose
            if frame in world:
                expected = np.linalg.solve(world[within], world[frame])
                np.testing.assert_allclose(matrix(*found), expected, atol=1e-12)


@pytest.mark.skipif(
    importlib.util.find_spec("tf2_py") is None, reason="tf2 is not on PyPI: needs ROS 2 itself"
)
def test_a_frame_is_where_tf2_has_it(peer):
    import rclpy.time
    import tf2_py
    from geometry_msgs.msg import TransformStamped
    from rclpy.serialization import serialize_message
    from tf2_msgs.msg import TFMessage

    from adp_path_follower.ros.runtime.conversions import quaternion_of

    frames, core = Frames(peer.node), tf2_py.BufferCore()
    with pytest.raises(FrameError):
        frames.place("odom", "map")
    for parent, child, turn in (("map", "odom", 0.3), ("map", "other", -2.0)):
        item = TransformStamped(child_frame_id=child)
        item.header.frame_id, item.header.stamp.sec = parent, 100
        item.transform.translation.x, item.transform.translation.y = 1.0, -2.0
        item.transform.rotation = quaternion_of(turn)
        core.set_transform(item, "test")
        frames._take(False, serialize_message(TFMessage(transforms=[item])))
    found = core.lookup_transform_core("other", "odom", rclpy.time.Time()).transform
    x, y, turn = frames.place("odom", "other").pose
    assert (x, y) == pytest.approx((found.translation.x, found.translation.y), abs=1e-12)
    assert math.sin(0.5 * turn) == pytest.approx(found.rotation.z, abs=1e-12)
