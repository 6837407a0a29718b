"""State the version of levid."""

__version__ = "0.1.0"
