"""levid flies, excites, logs and identifies a magnetically levitated platform."""

__version__ = "0.1.0"
