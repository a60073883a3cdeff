"""ROS 2 nodes: thin, no mathematics."""
