"""Between ROS messages and the core's arrays."""

import math

import numpy as np
from geometry_msgs.msg import Pose, PoseStamped, Quaternion, Twist
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from std_msgs.msg import Header

from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.geometry import FloatArray, yaw_of_quaternion
from adp_path_follower.core.safety.odometry_check import Measurement
from adp_path_follower.messages.raw import CdrError, read_odometry, stamped_numbers, twist_numbers

NANOSECONDS = 1_000_000_000


def stamp_nanoseconds(header: Header) -> int:
    """Return a header's stamp [ns]."""
    return int(header.stamp.sec) * NANOSECONDS + int(header.stamp.nanosec)


def make_header(time: int, frame: str) -> Header:
    """Return a header with a time [ns]."""
    header = Header(frame_id=frame)
    header.stamp.sec, header.stamp.nanosec = divmod(time, NANOSECONDS)
    return header


def quaternion_of(yaw: float) -> Quaternion:
    """Return the rotation by a heading [rad]."""
    return Quaternion(z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))


def measurement_of(raw: bytes) -> Measurement:
    """Return the content of serialised odometry; AdpError if a robot cannot have it."""
    try:
        found = read_odometry(raw)
    except CdrError as error:
        raise AdpError(f"odometry cannot be read: {error}") from None
    squared_norm = sum(part * part for part in found.quaternion)
    if not math.isfinite(squared_norm):
        x, y, z, w = found.quaternion
        raise AdpError(f"odometry orientation is not finite: x {x}, y {y}, z {z}, w {w}")
    if squared_norm < 1e-6:
        raise AdpError("odometry orientation is a quaternion of zero norm")
    if not found.frame:
        raise AdpError("odometry has no frame: set header.frame_id, as in 'odom'")
    (x, y, _), v, w = found.position, found.linear, found.angular
    if not all(map(math.isfinite, (x, y, v, w))):
        raise AdpError(f"odometry is not finite: x {x}, y {y}, v {v}, w {w}")
    return Measurement(
        stamp=found.seconds * NANOSECONDS + found.nanoseconds,
        pose=np.array([x, y, yaw_of_quaternion(*found.quaternion)]),
        twist=np.array([v, w]),
        frame=found.frame,
        child_frame=found.child_frame,
    )


def odometry_message(
    time: int, pose: FloatArray, twist: FloatArray, frames: tuple[str, str]
) -> Odometry:
    """Return odometry of a pose (3,) and twist (2,) in the frames (odom, base)."""
    message = Odometry(header=make_header(time, frames[0]), child_frame_id=frames[1])
    message.pose.pose = pose_message(pose)
    message.twist.twist.linear.x = float(twist[0])
    message.twist.twist.angular.z = float(twist[1])
    return message


def pose_message(pose: FloatArray) -> Pose:
    """Return a planar pose (3,) as a message."""
    message = Pose(orientation=quaternion_of(float(pose[2])))
    message.position.x, message.position.y = float(pose[0]), float(pose[1])
    return message


def pose_stamped(time: int, frame: str, pose: FloatArray) -> PoseStamped:
    """Return a planar pose (3,) with a stamp [ns]."""
    return PoseStamped(header=make_header(time, frame), pose=pose_message(pose))


def poses_message(poses: FloatArray, frame: str, time: int) -> PathMessage:
    """Return poses (N, 3) as a path; those without heading (NaN) get the identity."""
    message = PathMessage(header=make_header(time, frame))
    headed = np.column_stack([poses[:, :2], np.nan_to_num(poses[:, 2])])
    message.poses = [pose_stamped(time, frame, pose) for pose in headed]
    return message


def twist_message(command: FloatArray) -> Twist:
    """Return a command [v, w] as a message."""
    message = Twist()
    message.linear.x, message.angular.z = float(command[0]), float(command[1])
    return message


def twist_stamped(time: int, frame: str, command: FloatArray) -> bytes:
    """Return a command [v, w] with a stamp [ns] as a serialised TwistStamped."""
    return stamped_numbers(time, frame, twist_numbers(command))
