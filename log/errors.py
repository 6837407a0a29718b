"""The one error that this room raises for what a user or a damaged file can get wrong."""


class LogError(Exception):
    """A log that cannot be read, written or imported; says what was expected, found, and where."""
