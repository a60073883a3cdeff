"""Errors whose message is one sentence that a user can act on."""


class AdpError(Exception):
    """Report a bad input: its text names the thing, the value and the remedy."""


class SettingsError(AdpError, ValueError):
    """Report a setting that is unknown, of the wrong type or out of its range."""


class PathError(AdpError, ValueError):
    """Report a path that cannot be followed."""


class FileError(AdpError, OSError):
    """Report a file that is missing, empty or of another format."""
