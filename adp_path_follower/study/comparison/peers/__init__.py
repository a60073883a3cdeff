"""Published controllers behind the interface of this one.

May import `core`. Never knows this project's controller.
"""
