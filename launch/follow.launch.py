"""Follow a path: controller and path publisher, on request with simulated robot and recorder."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import (
    EqualsSubstitution,
    IfElseSubstitution,
    LaunchConfiguration,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = "adp_path_follower"
BOOLEAN = ["true", "True", "TRUE", "1", "false", "False", "FALSE", "0"]


def generate_launch_description() -> LaunchDescription:
    """Return the launch arguments and the nodes."""
    path = LaunchConfiguration("path")
    use_sim_time = _boolean("use_sim_time")
    tf = LaunchConfiguration("tf")
    common = {
        "package": PACKAGE,
        "namespace": LaunchConfiguration("namespace"),
        "output": "screen",
        "on_exit": Shutdown(),
        "remappings": [
            ("odom", LaunchConfiguration("odom")),
            ("cmd_vel", LaunchConfiguration("cmd_vel")),
            ("path", LaunchConfiguration("path_topic")),
            ("/tf", tf),
            ("/tf_static", [tf, "_static"]),
        ],
    }
    # Not in `parameters`, where launch_ros goes on without a file that is missing.
    arguments = [
        "--params-file",
        LaunchConfiguration("params_file"),
        "--log-level",
        LaunchConfiguration("log_level"),
    ]
    # The lissajous leaves the origin at atan2(30, 10), line and circle along x. Given before
    # params_file, so that the file may say otherwise.
    heading = IfElseSubstitution(
        EqualsSubstitution(path, "lissajous"), if_value="1.2490", else_value="0.0"
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution(
                    [FindPackageShare(PACKAGE), "config", "default.yaml"]
                ),
                description="YAML file with the parameters of the nodes, as in the package's "
                "config directory.",
            ),
            DeclareLaunchArgument(
                "path",
                default_value="lissajous",
                description="Path to follow: lissajous (the paper's figure eight), line, "
                "circle:KAPPA (curvature in 1/m, positive to the left), a CSV or YAML file, or "
                "none: it comes from another node.",
            ),
            DeclareLaunchArgument(
                "odom", default_value="odom", description="Topic of the odometry."
            ),
            DeclareLaunchArgument(
                "cmd_vel", default_value="cmd_vel", description="Topic of the command."
            ),
            DeclareLaunchArgument(
                "path_topic", default_value="path", description="Topic of the path."
            ),
            DeclareLaunchArgument(
                "tf",
                default_value="/tf",
                description="Topic of the transforms; tf is that of the namespace.",
            ),
            DeclareLaunchArgument(
                "node_name", default_value="path_follower", description="Name of the controller."
            ),
            DeclareLaunchArgument(
                "autostart",
                default_value="true",
                choices=BOOLEAN,
                description="Activate the controller at once, not by a lifecycle manager.",
            ),
            DeclareLaunchArgument(
                "movement_time_allowance",
                default_value="inf",
                description="Time without progress [s] after which the robot is told to stop.",
            ),
            DeclareLaunchArgument(
                "use_sim",
                default_value="true",
                choices=BOOLEAN,
                description="Simulate the robot. It starts at the origin, headed along the "
                "built-in paths; x, y and theta of unicycle_sim in params_file change that.",
            ),
            DeclareLaunchArgument(
                "fault_script",
                default_value="",
                description="Script of timed faults of the simulated robot: a YAML file, or "
                "the name of one in the package's config/faults, such as push.",
            ),
            DeclareLaunchArgument(
                "record",
                default_value="false",
                choices=BOOLEAN,
                description="Record the run into a rosbag2 bag.",
            ),
            DeclareLaunchArgument(
                "bag",
                default_value="",
                description="Directory of the bag, which must not exist yet; empty makes "
                "adp_run_DATE in the current directory.",
            ),
            DeclareLaunchArgument(
                "namespace",
                default_value="",
                description="Namespace of all nodes and topics but /clock and /diagnostics.",
            ),
            DeclareLaunchArgument(
                "use_sim_time",
                default_value="false",
                choices=BOOLEAN,
                description="Take the time from /clock; the simulator then publishes it.",
            ),
            DeclareLaunchArgument(
                "log_level",
                default_value="info",
                choices=["debug", "info", "warn", "error", "fatal"],
                description="Least severity that the nodes log.",
            ),
            Node(
                executable="controller",
                name=LaunchConfiguration("node_name"),
                ros_arguments=arguments,
                parameters=[
                    {
                        "use_sim_time": use_sim_time,
                        "autostart": _boolean("autostart"),
                        "movement_time_allowance": ParameterValue(
                            LaunchConfiguration("movement_time_allowance"), value_type=float
                        ),
                    }
                ],
                **common,
            ),
            Node(
                executable="path_publisher",
                name="path_publisher",
                ros_arguments=arguments,
                parameters=[
                    {"path": ParameterValue(path, value_type=str), "use_sim_time": use_sim_time}
                ],
                condition=UnlessCondition(EqualsSubstitution(path, "none")),
                **common,
            ),
            Node(
                executable="sim_unicycle",
                name="unicycle_sim",
                ros_arguments=["-p", ["theta:=", heading], *arguments],
                parameters=[
                    {
                        "publish_clock": use_sim_time,
                        "fault_script": ParameterValue(
                            LaunchConfiguration("fault_script"), value_type=str
                        ),
                    }
                ],
                condition=IfCondition(LaunchConfiguration("use_sim")),
                **common,
            ),
            Node(
                executable="recorder",
                name="recorder",
                ros_arguments=arguments,
                parameters=[
                    {
                        "output": ParameterValue(LaunchConfiguration("bag"), value_type=str),
                        "use_sim_time": use_sim_time,
                    }
                ],
                condition=IfCondition(LaunchConfiguration("record")),
                **common,
            ),
        ]
    )


def _boolean(name: str) -> ParameterValue:
    """Return a launch argument as a parameter that is true or false, however it was spelled."""
    plain = IfElseSubstitution(LaunchConfiguration(name), if_value="true", else_value="false")
    return ParameterValue(plain, value_type=bool)
