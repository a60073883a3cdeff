"""Follow a path: controller and path publisher, on request with simulated robot and recorder."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.conditions import IfCondition
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
BOOLEAN = ["true", "false"]


def generate_launch_description() -> LaunchDescription:
    """Return the launch arguments and the nodes."""
    path = LaunchConfiguration("path")
    use_sim_time = LaunchConfiguration("use_sim_time")
    common = {
        "package": PACKAGE,
        "namespace": LaunchConfiguration("namespace"),
        "output": "screen",
        "on_exit": Shutdown(),
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
                "circle:KAPPA (curvature in 1/m, positive to the left), or a CSV or YAML file.",
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
                name="path_follower",
                ros_arguments=arguments,
                parameters=[{"use_sim_time": use_sim_time}],
                **common,
            ),
            Node(
                executable="path_publisher",
                name="path_publisher",
                ros_arguments=arguments,
                parameters=[
                    {"path": ParameterValue(path, value_type=str), "use_sim_time": use_sim_time}
                ],
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
