"""Follow paths with a unicycle robot by online approximate optimal control."""

__version__ = "0.1.0"
