"""The path follower without ROS: numpy and scipy only, importable anywhere."""
