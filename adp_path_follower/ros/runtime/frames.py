"""Where frames are, from /tf and /tf_static, where `tf2_msgs` is installed.

The frames are taken to be level, as those between a path and odometry are. The latest transform of
each pair counts: what it is at the time of the odometry would be known only later.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray, pose_in_frame, tracking_error
from adp_path_follower.messages.cdr import CdrError
from adp_path_follower.messages.raw import read_transforms, way_between

_TOPICS = {"/tf": DurabilityPolicy.VOLATILE, "/tf_static": DurabilityPolicy.TRANSIENT_LOCAL}
_DEPTH = 100


class FrameError(AdpError):
    """Report a transform that is not known (yet)."""


@dataclass(frozen=True, eq=False)
class FramePlace:
    """The place of a frame in another one."""

    pose: FloatArray  # x [m], y [m], turn [rad], shape (3,)
    stamp: int | None  # time of the oldest transform in it [ns], None where all are static
    between: tuple[str, ...]  # the frames on the way from the one to the other, both ends included


class Frames:
    """Listens to transforms from the first question on."""

    def __init__(self, node: Node) -> None:
        """Do nothing yet; raise ImportError without `tf2_msgs`."""
        from tf2_msgs.msg import TFMessage

        self._node, self._type = node, TFMessage
        self._subscriptions: list[Any] = []
        # Child frame -> its parent, its pose in it (3,), and the stamp [ns], None if static.
        self._edges: dict[str, tuple[str, FloatArray, int | None]] = {}
        self._known: dict[tuple[str, str], FramePlace] = {}

    def destroy(self) -> None:
        """End the subscriptions."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []

    def place(self, frame: str, within: str) -> FramePlace:
        """Return where a frame is in another one; raise FrameError while that is not known."""
        if not self._subscriptions:
            self._listen()
        found = self._known.get((frame, within))
        if found is None:
            found = self._known[frame, within] = self._found(frame, within)
        return found

    def _listen(self) -> None:
        for topic, durability in _TOPICS.items():
            qos = QoSProfile(depth=_DEPTH, durability=durability)
            take = functools.partial(self._take, topic == "/tf_static")
            self._subscriptions.append(
                self._node.create_subscription(self._type, topic, take, qos, raw=True)
            )

    def _take(self, is_static: bool, raw: bytes) -> None:
        try:
            found = read_transforms(raw)
        except CdrError:
            return
        for item in found:
            if math.isfinite(sum(item.pose)):
                stamp = None if is_static else item.stamp
                self._edges[item.child] = item.parent, np.array(item.pose), stamp
        # Most transforms are of joints, which are on no way to a path.
        changed = {item.child for item in found}
        if any(changed.intersection(place.between) for place in self._known.values()):
            self._known.clear()

    def _found(self, frame: str, within: str) -> FramePlace:
        way = way_between(self._parent, frame, within)
        if way is None:
            raise FrameError(f"no transform from '{frame}' to '{within}' is known")
        rising, falling, shared = way
        pose = np.zeros(3)
        for name in rising:
            pose = pose_in_frame(pose, self._edges[name][1])
        for name in falling:
            pose = tracking_error(pose, self._edges[name][1])
        stamps = [self._edges[name][2] for name in (*rising, *falling)]
        oldest = min((stamp for stamp in stamps if stamp is not None), default=None)
        return FramePlace(pose, oldest, (*rising, shared, *falling))

    def _parent(self, frame: str) -> str | None:
        edge = self._edges.get(frame)
        return None if edge is None else edge[0]
