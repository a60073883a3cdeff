"""Any messages that hypothesis can build."""

from __future__ import annotations

import math

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from hypothesis import strategies as st
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage

PERIOD = 20_000_000  # [ns]

floats = st.one_of(
    st.floats(),
    st.floats(-3.0, 3.0),
    st.sampled_from([0.0, 1e6, -1e6, 1e8, 1e9, 1e160, 1e308, 5e-324, math.nan, math.inf]),
)
stamps = st.one_of(
    st.builds(Time, sec=st.integers(-(2**31), 2**31 - 1), nanosec=st.integers(0, 2**32 - 1)),
    st.integers(0, 50).map(lambda step: Time(sec=0, nanosec=step * PERIOD)),
)
names = st.one_of(st.sampled_from(["odom", "base_link", "map", ""]), st.text(max_size=5))
positions = st.builds(Point, x=floats, y=floats, z=floats)
rotations = st.one_of(
    st.builds(Quaternion, x=floats, y=floats, z=floats, w=floats), st.just(Quaternion(w=1.0))
)
poses = st.builds(Pose, position=positions, orientation=rotations)


@st.composite
def odometry(draw):
    message = Odometry(child_frame_id=draw(names))
    message.header.stamp, message.header.frame_id = draw(stamps), draw(names)
    message.pose.pose = draw(poses)
    twist = message.twist.twist
    twist.linear.x, twist.linear.y, twist.angular.z = draw(floats), draw(floats), draw(floats)
    return message


@st.composite
def paths(draw):
    message = PathMessage()
    message.header.stamp, message.header.frame_id = draw(stamps), draw(names)
    found = draw(st.lists(poses, max_size=8))
    message.poses = [PoseStamped(pose=pose) for pose in found]
    return message
