"""The controller without ROS: settings, path, control, learning, driving and safety.

May import numpy, scipy, PyYAML and nothing of the package outside `core`.
Never imports ROS, draws pictures, or reads files other than its own.
"""
