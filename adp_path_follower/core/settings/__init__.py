"""All settings of the controller, their schema and their YAML files.

May import the ground of `core`: errors, geometry, files, basis.
Never knows a path, a robot or a learner.
"""
