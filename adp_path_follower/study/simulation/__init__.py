"""The closed loop of controller and simulated robot without ROS.

May import `core` and `sim_unicycle`. Never draws or records.
"""
