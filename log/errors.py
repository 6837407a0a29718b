"""Define the error that log/ raises for wrong input and damaged files."""


class LogError(Exception):
    """A log cannot be read, written or imported: where, what was expected and what was found."""
