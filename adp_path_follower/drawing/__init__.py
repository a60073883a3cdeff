"""Turns arrays into pictures and pages: style, charts, figures, templates.

May import `core`. Never reads bags or imports ROS.
"""
