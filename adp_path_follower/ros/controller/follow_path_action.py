"""The action `follow_path` of Nav2's controller server, where `nav2_msgs` is installed."""

import math
import time as steady
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node
from rclpy.serialization import serialize_message

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.geometry import FloatArray, yaw_of_quaternion
from adp_path_follower.core.path.progress import Place
from adp_path_follower.core.safety.supervisor import Kind, State, Status
from adp_path_follower.core.settings.navigation import NavigationSettings
from adp_path_follower.ros.controller.path_input import PathAnswer, PathInput
from adp_path_follower.ros.runtime.conversions import pose_message
from adp_path_follower.ros.runtime.qos import LATCHED

_RESULT_TIMEOUT = 10  # [s] that a result is kept, as in Nav2
_WAY = 0.01  # [m] to a single pose
_HARDLY = 1e-9  # about half of a turn [rad] that nobody sees

# The error code of each kind of cause, by its name in the result of the action.
_CODES = {
    Kind.PROGRESS: "FAILED_TO_MAKE_PROGRESS",
    Kind.DEVIATION: "NO_VALID_CONTROL",
    Kind.COMMAND: "NO_VALID_CONTROL",
    Kind.LATE: "CONTROLLER_TIMED_OUT",
    Kind.TRANSFORM: "TF_ERROR",
}
_WAITS_FOR_SOMEBODY = (Kind.PROGRESS, Kind.DEVIATION)  # no patience helps


@dataclass(frozen=True)
class Site:
    """The parts of the controller that an action reads."""

    settings: Callable[[], NavigationSettings]
    status: Callable[[], Status]
    active: Callable[[], bool]
    driver: Callable[[], Driver]
    speed: Callable[[], float]  # of the robot [m/s]
    pose: Callable[[str], FloatArray | None]  # of the robot (3,) in a frame, if it is known
    hurry: Callable[[], None]  # asks for `look` soon


class FollowPathAction:
    """Lets the controller follow the path of one goal at a time; the last one commands."""

    def __init__(self, node: Node, path: PathInput, site: Site) -> None:
        """Offer the action where `nav2_msgs` is installed, else there will never be a goal."""
        self._path, self._site = path, site
        self._node, self._logger = node, node.get_logger()
        self._goal: ServerGoalHandle | None = None
        self._is_unseen = False  # a goal of one place, as nothing says where the robot is
        self._standing_since: float | None = None  # steady [s]
        self._server: _Server | None = None
        try:
            from nav2_msgs.action import FollowPath
        except ImportError:
            self._logger.info("no action follow_path: nav2_msgs is not installed")
            return
        self._type = FollowPath
        self._followed = node.create_publisher(PathMessage, "~/goal_path", LATCHED)
        self._server = _Server(
            *(node, FollowPath, "follow_path"),
            execute_callback=lambda _: None,  # is never called, but rclpy asks for one
            goal_callback=self._wanted,
            handle_accepted_callback=self._begin,
            cancel_callback=self._cancel,
            result_timeout=_RESULT_TIMEOUT,
        )

    def destroy(self) -> None:
        """Withdraw the action."""
        if self._server is not None:
            self._server.destroy()
            self._node.destroy_publisher(self._followed)

    def path_followed(self, found: PathAnswer) -> None:
        """Publish a path that is followed for a goal, so that a recording is complete."""
        if found.request.goal is not None:
            self._followed.publish(found.request.raw)

    def path_on_topic(self) -> None:
        """End the goal, because a path has come on the topic: the last one commands."""
        if self._goal is not None:
            why = "a path on the topic takes over from the goal of follow_path"
            self._logger.info(why)
            self._end(self._goal.abort, "UNKNOWN", why)

    def path_refused(self, found: PathAnswer) -> None:
        """End the goal whose path cannot be followed."""
        if self._goal is not None and found.request.goal is self._goal:
            self._abort("INVALID_PATH", self._path.problem)
        elif self._goal is None and self._path.goal is not None:
            self._path.stop()  # its goal has ended

    def deactivated(self) -> None:
        """End the goal, as nobody is there to drive."""
        if self._goal is not None:
            self._abort("UNKNOWN", "the controller was deactivated")

    def look(self) -> None:
        """Tell how far the robot is, and end the goal if it is reached, cancelled or hopeless."""
        goal = self._goal
        if goal is None:
            return
        if goal.is_cancel_requested:
            self._end(goal.canceled, "NONE")
            return
        if self._is_unseen and self._site.pose(goal.request.path.header.frame_id) is not None:
            self._lead(goal)
        is_followed: bool = self._path.goal is goal
        if not is_followed:  # it is being prepared
            return
        feedback = self._type.Feedback(speed=self._site.speed())
        feedback.distance_to_goal = distance_to_goal(self._site.driver())
        goal.publish_feedback(feedback)
        status = self._site.status()
        if status.state is State.GOAL_REACHED:
            self._logger.info("goal of follow_path reached")
            self._end(goal.succeed, "NONE")
        elif status.state is State.FOLLOWING:
            self._standing_since = None
        else:
            self._stand(status)

    def _stand(self, status: Status) -> None:
        """Abort the goal of a robot that may not drive, at once or when patience is over."""
        now = steady.monotonic()
        since = self._standing_since = self._standing_since or now
        over = now - since >= self._site.settings().failure_tolerance
        if over or status.kind in _WAITS_FOR_SOMEBODY:
            self._abort(_CODES.get(status.kind, "PATIENCE_EXCEEDED"), status.cause)

    def _wanted(self, request: Any) -> GoalResponse:
        if self._site.active():
            return GoalResponse.ACCEPT
        self._logger.warning("goal of follow_path rejected: the controller is not active")
        return GoalResponse.REJECT

    def _begin(self, goal: ServerGoalHandle) -> None:
        """Follow a goal's path; the robot drives on along the present one until it is prepared."""
        if self._goal is not None:
            self._end(self._goal.abort, "NONE", "another goal takes over")
        self._goal, self._standing_since, self._is_unseen = goal, None, False
        goal.execute()
        request, settings = goal.request, self._site.settings()
        for name, known, code in (
            ("controller", settings.controller_ids, "INVALID_CONTROLLER"),
            ("goal_checker", settings.goal_checker_ids, "UNKNOWN"),
            ("progress_checker", settings.progress_checker_ids, "UNKNOWN"),
        ):
            given = getattr(request, f"{name}_id", "")  # some versions of Nav2 lack the last
            if given and given not in known:
                self._abort(code, f"{name}_id '{given}' is none of {name}_ids, {', '.join(known)}")
                return
        if not request.path.poses:
            self._abort("INVALID_PATH", "its path has no poses")
            return
        if _is_one_place(request.path):  # as planners send it to a robot that is almost there
            self._lead(goal)
        else:
            self._path.submit(serialize_message(request.path), goal)

    def _lead(self, goal: ServerGoalHandle) -> None:
        """Lead the robot to a goal that is one place."""
        header, poses = goal.request.path.header, goal.request.path.poses
        robot = self._site.pose(header.frame_id)
        tolerance = self._site.driver().settings.motion.xy_goal_tolerance
        way = PathMessage(header=header, poses=_way_to(poses[-1], robot, tolerance))
        self._is_unseen = robot is None
        self._path.submit(serialize_message(way), goal)

    def _cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        if goal is self._goal:
            self._logger.info("goal of follow_path cancelled")
            self._path.stop()
            self._site.hurry()
        return CancelResponse.ACCEPT

    def _abort(self, code: str, why: str) -> None:
        """End the goal without success, and with it the drive."""
        assert self._goal is not None  # the caller has looked
        self._logger.error(f"goal of follow_path aborted: {why}")
        self._end(self._goal.abort, code, why)
        self._path.stop()

    def _end(self, change: Callable[[], None], code: str, why: str = "") -> None:
        assert self._server is not None  # a goal has come through it
        goal, self._goal = self._goal, None
        result = self._type.Result(error_code=getattr(self._type.Result, code), error_msg=why)
        self._server.end(goal, change, result)


def distance_to_goal(driver: Driver) -> float:
    """Return the length of the route that is left [m], 0 without one."""
    if driver.route is None or driver.follower is None:
        return 0.0 if driver.route is None else driver.route.length
    here = Place(driver.segment, float(driver.follower.arc_length))
    return max(0.0, driver.route.length - here.along(driver.route))


def _is_one_place(path: PathMessage) -> bool:
    """Return whether all poses of a path are in one place; long paths are not looked through."""
    first = path.poses[0].pose.position
    return all((at := item.pose.position).x == first.x and at.y == first.y for item in path.poses)


def _way_to(pose: PoseStamped, robot: FloatArray | None, tolerance: float) -> list[PoseStamped]:
    """Return poses that lead a robot (3,) straight to another one, with turns at both ends.

    Nearer than the tolerance [m], or where it is not known, it is as if it drove straight into it.
    """
    at, q = pose.pose.position, pose.pose.orientation
    if q.w == 1.0:  # a heading that is meant, where that of a whole path may be left out
        q.z = _HARDLY
    yaw = yaw_of_quaternion(q.x, q.y, q.z, q.w)
    if robot is None or math.dist(robot[:2], (at.x, at.y)) <= tolerance:
        way = [(at.x - _WAY * math.cos(yaw), at.y - _WAY * math.sin(yaw), yaw)]
    else:
        x, y, heading = robot.tolist()
        towards = math.atan2(at.y - y, at.x - x)
        way = [(x, y, heading), (x, y, towards), (at.x, at.y, towards)]
    before = [PoseStamped(header=pose.header, pose=pose_message(np.array(item))) for item in way]
    return [*before, pose]


class _Server(ActionServer):
    """Ends goals when it is told to.

    rclpy would keep a task for each goal, and look at it in every turn of its loop.
    """

    def notify_execute(self, goal_handle: Any, execute_callback: Any) -> None:
        """Leave it to the owner."""

    def end(self, goal: Any, change: Callable[[], None], result: Any) -> None:
        """Change a goal to its final state, and answer whoever waits for its result."""

        def finish(_: Any) -> Any:
            change()
            return result

        if self._node.executor is None:  # the node is about to go
            change()
        else:
            super().notify_execute(goal, finish)
