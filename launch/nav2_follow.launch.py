"""Start the controller in place of Nav2's controller_server: see docs/nav2.md."""

from launch import LaunchDescription
from launch.actions import IncludeLaunchDescription
from launch.substitutions import PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return follow.launch.py with the values that Nav2 needs; its arguments hold here, too."""
    file = [FindPackageShare("adp_path_follower"), "launch", "follow.launch.py"]
    values = {
        "node_name": "controller_server",
        "autostart": "false",  # the lifecycle manager activates it
        "movement_time_allowance": "10.0",
        "path": "none",
        "use_sim": "false",
    }
    return LaunchDescription(
        [IncludeLaunchDescription(PathJoinSubstitution(file), launch_arguments=values.items())]
    )
