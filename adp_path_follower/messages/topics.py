"""The topics of a run: their names and types, as nodes publish and bags hold them."""

NODE = "path_follower"
_ODOMETRY, _PATH = ("nav_msgs/msg/Odometry",), ("nav_msgs/msg/Path",)
_NUMBER, _ARRAY = ("std_msgs/msg/Float64",), ("std_msgs/msg/Float64MultiArray",)
# Key in `Run.series`, which is the last part of the topic's name as well -> the types it may have.
SERIES = {
    "odom": _ODOMETRY,
    "ground_truth": _ODOMETRY,
    "cmd_vel": ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"),
    "target": ("geometry_msgs/msg/PoseStamped",),
    "measured_pose": ("geometry_msgs/msg/Vector3Stamped",),
    "measured_motion": ("geometry_msgs/msg/Vector3Stamped",),
    "tracking_error": ("geometry_msgs/msg/Vector3Stamped",),
    "critic_weights": _ARRAY,
    "actor_weights": _ARRAY,
    "bellman_error": _NUMBER,
    "excitation": _NUMBER,
    "cost": _NUMBER,
    "robot_model": _ARRAY,
}
_OTHERS = {
    "path": _PATH,
    "goal_path": _PATH,
    "configuration": ("std_msgs/msg/String",),
    "initial_weights": ("std_msgs/msg/UInt8MultiArray",),
    "diagnostics": ("diagnostic_msgs/msg/DiagnosticArray",),
}
TYPES = {**SERIES, **_OTHERS}
PLAIN = ("odom", "cmd_vel", "path", "ground_truth", "diagnostics")  # not under the node's name
# Topics that are recorded unless others are asked for.
RUN_TOPICS = (
    *(key if key in PLAIN else f"{NODE}/{key}" for key in TYPES if key != "diagnostics"),
    *(f"{NODE}/status", "/diagnostics", "/tf", "/tf_static"),
)
# The debug topics of a control step, below the controller's name.
STEP_TOPICS = (
    *("target", "tracking_error", "critic_weights", "actor_weights"),
    *("bellman_error", "excitation", "cost"),
)
