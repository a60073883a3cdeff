"""ROS 2 nodes: messages to the core and back.

May import `bags`, `messages` and `core`. Never does mathematics or draws pictures.
"""
