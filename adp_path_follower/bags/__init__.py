"""Recording and reading rosbag2 bags."""
